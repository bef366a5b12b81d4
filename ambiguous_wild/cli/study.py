"""`aw study`: make a blind user study and score its answers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from ambiguous_wild.cli.options import (
    CommandGroup,
    PathName,
    json_option,
    only_option,
    seed_option,
    title_option,
)
from ambiguous_wild.io.terminal import say


@click.group("study", cls=CommandGroup)
def command() -> None:
    """Blind user study: how hard are distractors to see, and which render is better?

    \b
    aw study make runs --scene scene -o study.html    page for raters, and the private study.key.json
    aw study score answers/ --key study.key.json             shares, ranking, agreement
    """


@command.command("make")
@click.argument("runs", required=False, type=PathName())
@click.option(
    "--scene",
    "photos_of",
    multiple=True,
    type=PathName(),
    help="Ask about the training photos of this scene folder; repeatable.",
)
@click.option(
    "-o",
    "--output",
    required=True,
    type=PathName(dir_okay=False),
    help="The page, *.html; the key is written next to it.",
)
@click.option(
    "--method", "methods", multiple=True, help="Compare only this method; repeatable.  [default: all]"
)
@only_option
@click.option(
    "--questions",
    "limit",
    type=click.IntRange(1, 1000),
    default=40,
    show_default=True,
    help="Largest number of questions of each kind.",
)
@click.option(
    "--truth/--no-truth", default=True, show_default=True, help="Show the test photo next to the two renders."
)
@click.option(
    "--outline/--no-outline",
    default=True,
    show_default=True,
    help="Let raters show the distractor's outline, if the scene has exact masks.",
)
@click.option(
    "--side",
    type=click.IntRange(64, 4000),
    default=1000,
    show_default=True,
    help="Largest longer side of an image, px.",
)
@title_option("Picture study")
@seed_option("Seed of the choice of questions.")
@click.option(
    "--overwrite",
    is_flag=True,
    help="Replace an existing page and key; answers to the old page can no longer be scored.",
)
@json_option
def make_command(
    runs: Path | None, photos_of: tuple[Path, ...], output: Path, methods: tuple[str, ...], scenes: tuple[str, ...],
    truth: bool, outline: bool, overwrite: bool, as_json: bool,
    **settings: Any,  # fields of `StudySettings`
) -> None:  # fmt: skip
    """Write the study as one HTML file that works offline and on a phone. It asks about the test renders in RUNS
    (the output of 'aw bench'), about the photos of --scene, or about both.

    The page contains no names of methods, scenes or files. The key does: do not give it to raters.
    """
    from tqdm import tqdm

    from ambiguous_wild.core.errors import AwError
    from ambiguous_wild.core.names import is_text
    from ambiguous_wild.io.files import check_output
    from ambiguous_wild.study.make import Question, StudySettings, make_study, render_pairs, scene_photos

    if not photos_of and runs is None:
        raise AwError("nothing to ask about: give --scene SCENE (photos), RUNS (renders), or both")
    if (methods or scenes) and runs is None:
        raise AwError("--method and --only choose among runs: give RUNS too")
    if output.suffix.lower() not in (".html", ".htm"):
        raise AwError(
            f"the page must be named *.html, so that browsers open it: -o {output.with_suffix('.html')}"
        )
    if not is_text(title := settings["title"]):
        raise AwError(f"--title {title!a} contains half a character; set the terminal's encoding to UTF-8")
    key = output.with_suffix(".key.json")
    for wanted in (output, key):
        check_output(wanted)
    there = [str(p) for p in (output, key) if p.exists()]
    if there and not overwrite:
        raise AwError(
            f"{' and '.join(there)} {'exist' if len(there) > 1 else 'exists'}; answers to the old page could "
            "not be scored without its key; choose another -o, or replace it with --overwrite"
        )
    asked: list[Question] = []
    folders: dict[str, Path] = {}  # by name of the scene
    for folder in photos_of:
        photos = scene_photos(folder, outline=outline)
        if (other := folders.setdefault(photos[0].scene, folder)) is not folder:
            raise AwError(
                f"--scene {other} and --scene {folder} are both called {photos[0].scene}: their answers would "
                "count as those of one scene; give it once, or rename one in its scene.json"
            )
        asked += photos
    if runs is not None:
        asked += render_pairs(runs, methods=methods, scenes=scenes, truth=truth)
    study = make_study(
        asked,
        output,
        key,
        StudySettings(**settings),
        lambda q: tqdm(q, unit="question", disable=as_json or None),
    )
    if as_json:
        facts = {k: str(v) if isinstance(v, Path) else v for k, v in vars(study).items()}
        click.echo(json.dumps(facts, indent=2))
        return
    say(
        f"wrote {study.page} ({study.photos} questions about photos, {study.pairs} about renders, "
        f"{study.pictures} images, {study.megabytes:.1f} MB)",
        out=True,
    )
    say(f"wrote {study.key}: keep it private, it names the method of each render", out=True)


@command.command("score")
@click.argument("answers", nargs=-1, required=True, type=PathName())
@click.option(
    "--key",
    required=True,
    type=PathName(),
    help="The key that 'aw study make' wrote next to the page.",
)
@click.option(
    "-o",
    "--output",
    type=PathName(file_okay=False),
    help="Folder for scores.md, .csv and .json.  [default: KEY-scores]",
)
@json_option
def score_command(answers: tuple[Path, ...], key: Path, output: Path | None, as_json: bool) -> None:
    """Score ANSWERS: files (JSON or CSV) saved by raters, or folders of them."""
    from ambiguous_wild.io.files import check_output, is_record, refuse_files_there, refuse_foreign_files
    from ambiguous_wild.study.answers import read_answers, read_key
    from ambiguous_wild.study.score_report import SCORE_FILES, markdown_of, write_scores
    from ambiguous_wild.study.scores import score

    key_of_study = read_key(key)
    raters = read_answers(answers, key_of_study, lambda text: say(f"warning: {text}"))
    folder = output or key.with_name(key.name.removesuffix(".json").removesuffix(".key") + "-scores")
    if folder.is_dir():
        refuse_foreign_files(folder, SCORE_FILES)
        if not is_record(folder / "scores.json", "raters"):
            refuse_files_there(folder, SCORE_FILES)
    check_output(folder)
    scores = score(key_of_study, raters)
    write_scores(scores, folder)
    click.echo(json.dumps(scores, indent=2, ensure_ascii=False) if as_json else markdown_of(scores))
    if not as_json:
        say(f"wrote {folder}/scores.md, scores.csv and scores.json", out=True)
