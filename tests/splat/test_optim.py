"""The optimiser that puts rows off against torch's dense Adam and against its own dense mode."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.splat import backend
from ambiguous_wild.splat.cpu.cpu_render import render_cpu
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.rendered import Gradients

from .scenes import camera, gaussians

RATES = {
    "means": 1.6e-4,
    "quats": 1e-3,
    "log_scales": 5e-3,
    "opacity_logits": 5e-2,
    "sh0": 2.5e-3,
    "sh_rest": 1.25e-4,
}


def rates_at(step: int) -> dict[str, float]:
    return RATES | {"means": RATES["means"] * 0.99**step, "sh_rest": RATES["sh_rest"] * 0.995**step}


def gradients_at(g: Gaussians, step: int, seed=5) -> tuple[Gradients, torch.Tensor]:
    """Random gradients of the rows seen at a step: some never, one only at the start, one rarely."""
    rng = np.random.default_rng([seed, step])
    n = len(g)
    visible = torch.from_numpy(rng.uniform(size=n) < 0.3)
    visible[:2] = False
    if n > 4:
        visible[2], visible[3] = step < 3, step % 97 == 5
    values = {}
    for name, tensor in g.items():
        noise = 10.0 ** rng.uniform(-6, 0) * rng.normal(size=tensor.shape)
        values[name] = torch.from_numpy(np.float32(noise)) * visible.view(-1, *[1] * (tensor.dim() - 1))
    return Gradients(**values, screen=torch.zeros(n, 2)), visible


def equal(a: Gaussians, b: Gaussians) -> bool:
    return all(torch.equal(x, getattr(b, name)) for name, x in a.items())


@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_equals_torch_adam_run_dense(rest):
    lazy, dense = gaussians(0, 40, rest=rest), gaussians(0, 40, rest=rest)
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in lazy.items()}
    judge = torch.optim.Adam(
        [{"params": [leaf], "lr": 0.0, "name": k} for k, leaf in leaves.items()], eps=1e-15
    )
    a, b = SplatAdam(lazy, RATES), SplatAdam(dense, RATES, lazy=False)
    for step in range(300):
        grads, visible = gradients_at(lazy, step)
        a.step(grads, visible, rates_at(step))
        b.step(grads, visible, rates_at(step))
        for group in judge.param_groups:
            group["lr"] = rates_at(step)[group["name"]]
            group["params"][0].grad = getattr(grads, group["name"])
        judge.step()
    a.flush()
    assert equal(lazy, dense)
    for name, leaf in leaves.items():
        torch.testing.assert_close(getattr(lazy, name), leaf.detach(), rtol=1e-6, atol=2e-6)


def test_rows_put_off_for_long_take_the_same_bits_in_one_go_or_in_pieces():
    whole, pieces, dense = (gaussians(1, 30) for _ in range(3))
    a, b, c = SplatAdam(whole, RATES), SplatAdam(pieces, RATES), SplatAdam(dense, RATES, lazy=False)
    for step in range(800):
        grads, visible = gradients_at(whole, step)
        if step > 20:
            visible[:] = False
            for name in RATES:
                getattr(grads, name).zero_()
        for optimiser in (a, b, c):
            optimiser.step(grads, visible, rates_at(step))
        if step % 7 == 0:
            b.catch_up(np.arange(step % 30, 30, dtype=np.int32))
    a.flush()
    b.flush()
    assert equal(whole, dense)
    assert equal(pieces, dense)
    first, second = a.state_dict(), c.state_dict()
    for key in ("first", "second"):
        assert all(torch.equal(first[key][name], second[key][name]) for name in RATES)


def test_the_renderer_sees_rows_up_to_date():
    cam = camera()
    lazy, dense = gaussians(2, 50), gaussians(2, 50)
    a, b = SplatAdam(lazy, RATES), SplatAdam(dense, RATES, lazy=False)
    behind = False
    for step in range(20):
        grads, visible = gradients_at(lazy, step)
        rates = {name: 50 * rate for name, rate in RATES.items() if name == "sh_rest"}
        a.step(grads, visible, RATES | rates)
        b.step(grads, visible, RATES | rates)
        behind |= not torch.equal(lazy.sh_rest, dense.sh_rest)
        assert torch.equal(render_cpu(lazy, cam).image, render_cpu(dense, cam).image)
    assert behind  # otherwise nothing was put off and this test shows nothing


def stepped(seed=2, n=50):
    """Gaussians with rows put off, the same ones stepped at once, and the optimisers of both."""
    lazy, dense = gaussians(seed, n), gaussians(seed, n)
    a, b = SplatAdam(lazy, RATES), SplatAdam(dense, RATES, lazy=False)
    for step in range(12):
        grads, visible = gradients_at(lazy, step)
        a.step(grads, visible, RATES | {"sh_rest": 0.01})
        b.step(grads, visible, RATES | {"sh_rest": 0.01})
    assert not torch.equal(lazy.sh_rest, dense.sh_rest)  # otherwise nothing was put off
    return lazy, dense, a, b


@pytest.mark.parametrize("shared", [lambda g: replace(g, means=g.means + 0.1), lambda g: g.to("cpu")])
def test_what_shares_harmonics_has_its_rows_brought_up_to_date_where_it_is_drawn(shared):
    lazy, dense, a, b = stepped()
    moved, wanted = shared(lazy), shared(dense)
    for optimiser in (a, b):
        optimiser.step(*gradients_at(lazy, 12))
    assert not torch.equal(moved.sh_rest, wanted.sh_rest)
    assert torch.equal(render_cpu(moved, camera()).image, render_cpu(wanted, camera()).image)


ALL_ROWS = torch.ones(50, dtype=torch.bool)
COPIES = {
    "clone": lambda g: g.clone(),
    "select": lambda g: g.select(ALL_ROWS),
    "cat": lambda g: g.cat(gaussians(4, 3)).select(torch.arange(50)),
    "cat to others": lambda g: gaussians(4, 3).cat(g).select(torch.arange(3, 53)),
    "clone of what is carried on": lambda g: g.with_attributes({"more": torch.zeros(50)}).clone(),
}


@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
def test_copies_are_up_to_date_and_belong_to_no_optimiser(copied):
    lazy, dense, a, _ = stepped()
    copy = copied(lazy)
    assert equal(copy, dense) and copy.pending_steps is None
    a.step(*gradients_at(lazy, 12))
    copy.flush()
    assert equal(copy, dense)


def test_gaussians_that_were_left_behind_ask_for_no_more_updates():
    lazy, dense, a, _ = stepped()
    shared = replace(lazy, attributes={"more": torch.zeros(50)})
    stay = torch.arange(50) >= 10
    a.select(stay)
    assert equal(shared, dense)  # brought up to date before the rows went
    fewer = lazy.select(stay)
    a.bind(fewer)
    for step in (12, 13):
        a.step(*gradients_at(fewer, step))
    put_off = fewer.sh_rest.clone()
    shared.flush()
    render_cpu(shared, camera())
    assert equal(shared, dense) and torch.equal(fewer.sh_rest, put_off)
    fewer.flush()
    assert not torch.equal(fewer.sh_rest, put_off)  # otherwise nothing was put off


def test_a_hundred_thousand_steps_without_gradient_stay_finite():
    g = gaussians(3, 3)
    optimiser = SplatAdam(g, RATES)
    grads, visible = gradients_at(g, 0)
    visible[:] = True
    optimiser.step(grads, visible)
    zero = Gradients(**{name: torch.zeros_like(t) for name, t in g.items()}, screen=torch.zeros(3, 2))
    for _ in range(2000):
        optimiser.step(zero, torch.zeros(3, dtype=torch.bool))
    # The harmonics were put off; let 1e5 steps have passed for them without paying for the other tensors'.
    rates, roots = optimiser._history[:, 2000].tolist()
    optimiser._history = np.repeat(np.float32([[rates], [roots]]), 100_001, axis=1)
    optimiser.steps = 100_000
    optimiser.flush()
    state = optimiser.state_dict()
    for name, tensor in g.items():
        assert torch.isfinite(tensor).all()
        assert not state["first"][name].any()
        assert torch.isfinite(state["second"][name]).all()


def test_a_gaussian_never_seen_stays_where_it_was():
    g = gaussians(4, 10)
    before = g.clone()
    optimiser = SplatAdam(g, RATES)
    for step in range(30):
        optimiser.step(*gradients_at(g, step))
    optimiser.flush()
    for name, tensor in g.items():
        assert torch.equal(tensor[:2], getattr(before, name)[:2])
        assert not torch.equal(tensor, getattr(before, name)) or tensor.numel() == 0


def test_selected_and_appended_rows_keep_their_moments():
    g, whole = gaussians(5, 12), gaussians(5, 12)
    a, b = SplatAdam(g, RATES), SplatAdam(whole, RATES)
    for step in range(9):
        for optimiser, model in ((a, g), (b, whole)):
            optimiser.step(*gradients_at(model, step))
    stay = torch.ones(12, dtype=torch.bool)
    stay[[1, 7]] = False
    a.select(stay)
    a.append(3)
    with pytest.raises(RuntimeError, match="bind"):
        a.step(*gradients_at(g, 0))
    with pytest.raises(RuntimeError, match="12 Gaussians but moments for 13"):
        a.bind(g)
    g = g.select(stay).cat(gaussians(6, 3))
    a.bind(g)
    fresh = g.clone()
    for step in range(9, 20):
        grads, visible = gradients_at(whole, step)
        b.step(grads, visible)
        rows = {
            name: torch.cat([getattr(grads, name)[stay], torch.zeros_like(t[10:])]) for name, t in g.items()
        }
        a.step(Gradients(**rows, screen=torch.zeros(13, 2)), torch.cat([visible[stay], torch.zeros(3) > 0]))
    a.flush()
    b.flush()
    for name, tensor in g.items():
        assert torch.equal(tensor[:10], getattr(whole, name)[stay])
        assert torch.equal(tensor[10:], getattr(fresh, name)[10:])


def test_density_that_removes_all_and_starts_again():
    g = gaussians(5, 6)
    optimiser = SplatAdam(g, RATES)
    optimiser.step(*gradients_at(g, 0))
    optimiser.select(torch.zeros(6, dtype=torch.bool))
    empty = g.select(torch.zeros(6, dtype=torch.bool))
    optimiser.bind(empty)
    optimiser.step(*gradients_at(empty, 1))
    optimiser.append(4)
    again = empty.cat(gaussians(6, 4))
    optimiser.bind(again)
    optimiser.step(*gradients_at(again, 2))
    optimiser.flush()
    assert len(again) == 4


def test_reset_moments_forgets_only_what_is_named():
    g = gaussians(7, 8)
    optimiser = SplatAdam(g, RATES)
    for step in range(5):
        optimiser.step(*gradients_at(g, step))
    before = {k: {n: t.clone() for n, t in optimiser.state_dict()[k].items()} for k in ("first", "second")}
    optimiser.reset_moments(["opacity_logits"])
    optimiser.reset_moments(["sh_rest"], torch.tensor([4, 6]))
    after = optimiser.state_dict()
    for key in ("first", "second"):
        assert not after[key]["opacity_logits"].any()
        assert not after[key]["sh_rest"][[4, 6]].any()
        others = [0, 1, 2, 3, 5, 7]
        assert torch.equal(after[key]["sh_rest"][others], before[key]["sh_rest"][others])
        assert torch.equal(after[key]["means"], before[key]["means"])
    with pytest.raises(AwError, match="did you mean 'means'"):
        optimiser.reset_moments(["mean"])


@pytest.fixture
def accelerated(monkeypatch):
    """A function that makes an optimiser as an accelerator's tensors get one."""

    def make(model):
        with monkeypatch.context() as patch:
            patch.setattr(backend, "accelerated", lambda _: True)
            return SplatAdam(model, RATES)

    return make


def test_an_accelerator_takes_the_same_steps(accelerated):
    g, other = gaussians(9, 15), gaussians(9, 15)
    a, b = SplatAdam(g, RATES), accelerated(other)
    for step in range(50):
        grads, visible = gradients_at(g, step)
        a.step(grads, visible, rates_at(step))
        b.step(grads, visible, rates_at(step))
    a.flush()
    for name, tensor in g.items():
        torch.testing.assert_close(tensor, getattr(other, name), rtol=1e-6, atol=1e-6)
    assert b.state_dict()["steps"] == a.state_dict()["steps"] == 50


def test_a_step_called_off_on_the_device_never_was(accelerated):
    g, other = gaussians(9, 15), gaussians(9, 15)
    a, b = accelerated(g), accelerated(other)
    for step in range(6):
        grads, visible = gradients_at(g, step)
        a.step(grads, visible, skip_step=torch.zeros(1))
        b.step(grads, visible)
        before = other.clone()
        grads.means[:] = torch.nan
        b.step(grads, visible, skip_step=torch.ones(1))
        assert equal(other, before)
    assert equal(g, other)
    assert b.state_dict()["steps"] == 6


def test_an_accelerators_state_goes_on_on_the_cpu_and_back(accelerated):
    g, other = gaussians(9, 15), gaussians(9, 15)
    a, b = SplatAdam(g, RATES), accelerated(other)
    for step in range(10):
        grads, visible = gradients_at(g, step)
        a.step(grads, visible)
        b.step(grads, visible)
    a.flush()
    there, back = SplatAdam(other, RATES), accelerated(g)
    there.load_state_dict(b.state_dict())
    back.load_state_dict(a.state_dict())
    for step in range(10, 20):
        grads, visible = gradients_at(g, step)
        there.step(grads, visible)
        back.step(grads, visible)
    there.flush()
    for name, tensor in g.items():
        torch.testing.assert_close(tensor, getattr(other, name), rtol=1e-6, atol=1e-6)


def test_learning_rates_are_checked():
    g = gaussians(0, 4)
    with pytest.raises(AwError, match="learning rates lack sh_rest"):
        SplatAdam(g, {k: v for k, v in RATES.items() if k != "sh_rest"})
    with pytest.raises(AwError, match="did you mean 'quats'"):
        SplatAdam(g, RATES | {"quat": 1.0})
