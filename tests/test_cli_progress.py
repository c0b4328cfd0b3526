"""Progress: lines off a terminal, a bar on one, and silence where it is asked for."""

import io
import json
import sys
import time

import pytest
from rich.console import Console

from strapdown.cli import terminal
from strapdown.results import Table


@pytest.fixture
def said(monkeypatch):
    """Standard error as a file that is no terminal; lines come every tenth of a second."""
    text = io.StringIO()
    monkeypatch.setattr(terminal, "errors", Console(file=text, markup=False, highlight=False, width=200))
    monkeypatch.setattr(terminal, "LINE_INTERVAL", 0.1)
    monkeypatch.setattr(terminal, "_quiet", False)
    return text


def lines_of(text: io.StringIO) -> list[str]:
    return text.getvalue().splitlines()


def test_a_line_says_what_is_done_of_how_much(said):
    with terminal.progress_bar("runs", 30) as advance:
        advance(10)
        advanced = len(lines_of(said))
        for _ in range(1000):
            time.sleep(0.01)
            if len(lines_of(said)) >= advanced + 3:
                break
        lines = lines_of(said)[advanced + 1 :]  # the first may have been begun before the ten runs
        advance(20)
    assert len(lines) >= 2
    assert all(line.startswith("runs: 10 of 30, ") for line in lines)


@pytest.mark.parametrize("words", ["smoothing", "searches: 1 of 4"])
def test_a_step_of_unknown_length_prints_its_words_and_time(said, words):
    with terminal.progress_bar("smoothing") as advance:
        advance(words)
        time.sleep(0.15)
    assert set(lines_of(said)) == {f"{words}: 0 s"}


def test_what_is_quick_says_nothing_and_quiet_says_nothing(said, monkeypatch):
    with terminal.progress_bar("quick", 1) as advance:
        advance(1)
    monkeypatch.setattr(terminal, "_quiet", True)
    with terminal.progress_bar("long", 2):
        time.sleep(0.15)
    assert lines_of(said) == []


def test_a_terminal_has_a_bar(monkeypatch):
    text = io.StringIO()
    monkeypatch.setattr(terminal, "errors", Console(file=text, force_terminal=True, width=100))
    monkeypatch.setattr(terminal, "_quiet", False)
    with terminal.progress_bar("runs", 3) as advance:
        advance(2)
        time.sleep(0.3)
    assert " 67%" in text.getvalue()


def test_a_fault_ends_the_progress(said):
    with pytest.raises(ZeroDivisionError), terminal.progress_bar("runs", 3):
        _ = 1 / 0
    number = len(lines_of(said))
    time.sleep(0.25)
    assert len(lines_of(said)) == number


def test_quiet_may_stand_anywhere(succeeds, monkeypatch):
    heard = []
    for arguments in (("scenarios", "--quiet"), ("--quiet", "scenarios"), ("scenarios",)):
        monkeypatch.setattr(terminal, "_quiet", False)
        succeeds(*arguments)
        heard.append(terminal._quiet)
    assert heard == [True, True, False]
    assert sys.argv[-1] == "scenarios"


def test_json_on_standard_output_is_all_that_is_there(run, tmp_path):
    (tmp_path / "lines.csv").write_text("frequency_hz,angle_deg\n10,0.1\n", encoding="utf-8")
    status, said, other = run(
        "coning-budget", "--psd", "lines.csv", "--rate", 100, "--algorithm", "one-sample", "--json", "-"
    )
    assert status == 0
    assert json.loads(said)["lines"] == 1
    assert "Drift about the third axis" in other
    assert not (tmp_path / "-").exists()
    assert "Drift about the third axis" in run("coning-budget", "--psd", "lines.csv", "--rate", 100)[1]


@pytest.mark.parametrize(
    "show",
    [
        lambda name: terminal.PlainConsole(markup=False, highlight=False, soft_wrap=True).print(f"{name}: 1\n[red]2"),
        lambda name: terminal.show(Table("run \x1b[2K", ("sensor\x1b[1A", "test"), [(name, "pass")], left=2)),
    ],
    ids=["text", "table"],
)
def test_control_characters_of_names_do_not_reach_the_terminal(capsys, show):
    """Such as those that set its title, or hide the line before."""
    show("star\x1b]0;title\x07\x1b[2K\x9b1A\ttab")
    said = capsys.readouterr().out
    assert not {code for code in said if code not in "\t\n" and (ord(code) < 32 or 127 <= ord(code) < 160)}
    assert "star\N{REPLACEMENT CHARACTER}]0;title\N{REPLACEMENT CHARACTER}" in said
    assert ("[red]2" in said) == ("sensor" not in said)
