import pytest

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.names import check_name, name_from


@pytest.mark.parametrize(
    "name",
    [
        "scene",
        "Garten im März",
        "a.b-c_1",
        "花園",
        "हिन्दी",
        "St. Peter's & Paul #2",
        "3dgs@mask=a,density=b+2passes (2)",
        "x" * 100,
        "é" * 50,
    ],
)
def test_a_fit_name_comes_back_as_it_is(name):
    assert check_name("scene name", name) == name


def test_blanks_around_a_name_are_dropped():
    assert check_name("scene name", "  a b\n") == "a b"


@pytest.mark.parametrize(
    "name",
    [
        "",
        "  ",
        "\n",
        "a/b",
        "../x",
        "a\\b",
        "a\0b",
        "a\nb",
        "\x1b[31m",
        "\x9b",
        "\u202etxt",
        "\ud800",
        ".x",
        "-rf",
        "evil<b>",
        "a|b",
        "a`b`",
        "a;b",
        "[a](b)",
        "a:b",
        "..",
        "x" * 101,
        "é" * 51,
    ],
)
def test_an_unfit_name_is_refused_in_one_printable_line(name):
    with pytest.raises(AwError) as caught:
        check_name("scene name", name)
    said = str(caught.value)
    assert "scene name" in said and len(said) < 250
    assert said.isprintable()


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("Garten im März", "Garten im März"),
        ("Zürich — Tag 1: [Hof]", "Zürich _ Tag 1_ _Hof_"),
        ("-.hidden", "hidden"),
        ("..", "scene"),
        ("\ud800 \x1b[31m", "_ __31m"),
        ("é" * 60, "é" * 50),
        ("a" * 99 + "é", "a" * 99),
    ],
)
def test_any_text_becomes_a_fit_name(text, name):
    assert name_from(text) == name == check_name("scene name", name)
