"""Names and prose are in the field's words, not in the dialect that the package once had."""

import re
import symtable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PLACES = ("README.md", "strapdown/**/*.py", "docs/**/*.py", "docs/**/*.md", "sims/*.py", "benchmarks/*.py")
FILES = sorted(path for place in PLACES for path in ROOT.glob(place) if "_build" not in path.parts)
DIALECT = {
    r"(?<![A-Za-z])(un|fore)?told(?![A-Za-z])": "given, specified, reported",
    r"(?<![A-Za-z])(dis)?belie(f|ve[ds]?|ving)(?![A-Za-z])": "modelled, the filter's model, trusted",
    r"\b(tak(e|es|en|ing)|took) (it |them )?in(to the filter)?\b": "process, update with",
    r"\bso-manieth\b|\bby so (much|many)\b": "every n-th, by a given amount",
    r"not_covered": "unmodelled_errors",
    r"\bchallengers?\b": "restart candidate",
    r"\b_?(LEAST|MOST)_[A-Z]": "MIN_, MAX_",
    r"\b(has|have) seen\b": "the measurements so far",
    r"as good as (it|they) says?\b|too sure\b|too modest\b|says? of (itself|themselves)\b": "consistent, optimistic, pessimistic",
    r"\btaken for\b": "treated as, modelled as",
    r"\b(how )?so many\b": "the number of, at most",
    r"\bby itself\b": "separately",
    r"\bwhat [^.\n]{1,60} makes? of\b": "effect, contribution, result",
    r"\b[Ss]ource document\b": "Quaternion differentiation",
}


def dialect(text: str) -> list[str]:
    """Return what of the dialect a text holds, each with its line and the field's words."""
    return [
        f"{text.count(chr(10), 0, match.start()) + 1}: {match.group()!r}; better: {better}"
        for words, better in DIALECT.items()
        for match in re.finditer(words, text)
    ]


SAYS_NOTHING = {"found", "one", "given", "made", "chosen", "seen"}


def names_that_say_nothing(source: str) -> set[str]:
    """Return the names of variables and arguments that say how a value was obtained, not what it is."""
    names, tables = set(), [symtable.symtable(source, "", "exec")]
    while tables:
        table = tables.pop()
        tables += table.get_children()
        symbols = map(table.lookup, SAYS_NOTHING.intersection(table.get_identifiers()))
        names |= {symbol.get_name() for symbol in symbols if symbol.is_assigned() or symbol.is_parameter()}
    return names


def test_names_say_what_a_value_is():
    assert names_that_say_nothing("def f(given):\n    return [one for one in given]") == {"given", "one"}
    sources = [path for path in (*FILES, *ROOT.glob("tests/**/*.py")) if path.suffix == ".py"]
    wrong = {str(path.relative_to(ROOT)): names_that_say_nothing(path.read_text(encoding="utf-8")) for path in sources}
    allowed = {"strapdown/consistency/accuracy.py": {"given"}}  # of the table "as given", "aligned"
    assert {path: names for path, names in wrong.items() if names and names != allowed.get(path)} == {}


def test_prose_and_names_are_the_fields():
    findings = {str(path.relative_to(ROOT)): dialect(path.read_text(encoding="utf-8")) for path in FILES}
    assert {path: words for path, words in findings.items() if words} == {}
