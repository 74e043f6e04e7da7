"""A count agrees with its noun."""

import ast
import re
from itertools import pairwise
from pathlib import Path

import pytest

import chargetune
from chargetune.runtime.counted import counted

SOURCE = Path(chargetune.__file__).parent
VERBS = {"has", "is", "was", "keeps"}


@pytest.mark.parametrize(
    ("count", "nouns", "text"),
    [(1, ("trial",), "1 trial"), (0, ("trial",), "0 trials"), (2, ("study", "studies"), "2 studies"), (1, ("study", "studies"), "1 study")],
)
def test_one_and_several(count, nouns, text):
    assert counted(count, *nouns) == text


def plain_counts(source):
    """Every number of something that a text says with a plural, whatever the number is."""
    for node in ast.walk(ast.parse(source)):
        values = node.values if isinstance(node, ast.JoinedStr) else []
        for value, after in pairwise(values):
            if isinstance(value, ast.FormattedValue) and isinstance(after, ast.Constant):
                told = ast.unparse(value.value)
                noun = re.match(r" (?:[a-z]+ )?([a-z]+s)\b", after.value)
                if noun and noun[1] not in VERBS and re.match(r"len\(|np\.sum\(|sum\(|.*\.size$", told):
                    yield f"{told} {noun[1]}"


def test_every_text_says_a_count_by_it():
    found = {str(path.relative_to(SOURCE)): list(plain_counts(path.read_text())) for path in SOURCE.rglob("*.py")}
    assert {name: plain for name, plain in found.items() if plain} == {}


def test_a_plain_count_would_be_found():
    assert list(plain_counts('f"{len(done)} new trials"')) == ["len(done) trials"]
