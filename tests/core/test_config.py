"""Configs refuse what they do not know and survive the trip through plain data."""

import math
from dataclasses import dataclass, field
from typing import Literal

import pytest

from ambiguous_wild.core.config import check_limits, config_hash, from_plain, to_plain, with_options
from ambiguous_wild.core.errors import AwError


@dataclass(frozen=True)
class Inner:
    width: int = 3
    sizes: tuple[float, ...] = (1.0, 2.0)


@dataclass(frozen=True)
class Outer:
    name: str = "a"
    rate: float = 0.5
    mode: Literal["sum", "mean"] = "sum"
    limit: int | None = None
    on: bool = True
    inner: Inner = field(default_factory=Inner)


def test_plain_data_round_trip():
    config = Outer(name="b", limit=4, inner=Inner(7, (3.0,)))
    assert from_plain(Outer, to_plain(config)) == config


def test_hash_depends_on_every_value_and_on_nothing_else():
    assert config_hash(Outer()) == config_hash(Outer())
    changed = [Outer(name="b"), Outer(rate=0.25), Outer(mode="mean"), Outer(inner=Inner(width=4))]
    assert len({config_hash(c) for c in [Outer(), *changed]}) == 5


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"rate": "2"}, Outer(rate=2.0)),
        ({"limit": "none"}, Outer()),
        ({"limit": "12"}, Outer(limit=12)),
        ({"on": "false"}, Outer(on=False)),
        ({"inner.width": "9"}, Outer(inner=Inner(width=9))),
        ({"inner.sizes": "4,5.5"}, Outer(inner=Inner(sizes=(4.0, 5.5)))),
        ({"mode": "mean"}, Outer(mode="mean")),
        ({"name": "dinov2-small@504,normalise=raw"}, Outer(name="dinov2-small@504,normalise=raw")),
        ({"name": "1e3"}, Outer(name="1e3")),
        ({"inner.width": "9", "rate": "2", "inner.sizes": "4"}, Outer(rate=2.0, inner=Inner(9, (4.0,)))),
    ],
)
def test_options_of_the_command_line(options, expected):
    assert with_options(Outer(), options) == expected


@dataclass(frozen=True)
class Ordered:
    low: float = 1.0
    high: float = 2.0
    share: tuple[float, ...] = (0.5,)
    some: float | None = None

    def __post_init__(self) -> None:
        check_limits(self, "it", low=(0, math.inf), share=(0, 1), some=(1, 3))
        if self.low > self.high:
            raise AwError("low above high")


def test_options_are_judged_together():
    assert with_options(Ordered(), {"low": "5", "high": "7"}) == Ordered(5.0, 7.0)
    assert with_options(Ordered(), {"high": "7", "low": "5"}) == Ordered(5.0, 7.0)


@dataclass(frozen=True)
class Unlimited:
    rate: float = 0.1
    shift: float = -4.0
    exposure: float = 0.0


def test_what_is_positive_by_default_is_not_made_negative():
    made = with_options(Unlimited(), {"rate": "0", "shift": "-5", "exposure": "-1"})
    assert made == Unlimited(0.0, -5.0, -1.0)


@pytest.mark.parametrize(
    ("config", "options", "message"),
    [
        (Outer(), {"raet": "2"}, "did you mean 'rate'"),
        (Outer(), {"inner.widht": "2"}, "did you mean 'width'"),
        (Outer(), {"rate": "fast"}, "expected float, got 'fast'"),
        (Outer(), {"mode": "maen"}, "did you mean 'mean'"),
        (Outer(), {"rate.x": "1"}, "no keys of its own"),
        (Outer(), {"limit": "1.5"}, "limit"),
        (Outer(), {"on": "2"}, "expected bool"),
        (Ordered(), {"low": "5"}, "low above high"),
        (Ordered(), {"low": "-1"}, "it.low is at least 0, got -1"),
        (Ordered(), {"share": "0.5,1.5"}, "it.share is from 0 to 1, got 1.5"),
        (Ordered(), {"some": "4"}, "it.some is from 1 to 3, got 4"),
        (Unlimited(), {"rate": "-0.1"}, r"option rate is at least 0, got -0\.1"),
    ],
)
def test_what_does_not_fit_is_named(config, options, message):
    with pytest.raises(AwError, match=message):
        with_options(config, options)


def test_unknown_key_of_a_file_names_the_nearest():
    with pytest.raises(AwError, match="did you mean 'inner'"):
        from_plain(Outer, {"iner": {}})
