"""What the commands may write: no file that they read, nothing of another kind, and what exists only when asked to."""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import chargetune

from chargetune.cli.outputs import Kind, Output, claim, kind_of
from chargetune.study.files import try_whole, write_whole
from study_text import study_text

sys.path.insert(0, str(Path(__file__).parents[1] / "report"))

from report_studies import charging, run_charging

pytestmark = pytest.mark.usefixtures("virtual_machine")
EXAMPLES = Path(__file__).parents[2] / "examples"
PULSES = Path(__file__).parents[1] / "battery" / "identification" / "cases" / "16_underscore_units.csv"


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    return run_charging(tmp_path_factory.mktemp("outputs") / "charge.sqlite", charging()).read_bytes()


@pytest.fixture
def folder(tmp_path, studied):
    """A folder with a store, a study file, a cell file and a measurement, and links to the store."""
    (tmp_path / "charge.sqlite").write_bytes(studied)
    (tmp_path / "cell.toml").write_text((EXAMPLES / "okane2022.toml").read_text())
    (tmp_path / "study.toml").write_text(study_text(study={"trials": 1}, cell={"file": "cell.toml"}))
    (tmp_path / "cells").mkdir()
    for i in range(3):
        (tmp_path / "cells" / f"{i}.toml").write_text((EXAMPLES / "okane2022.toml").read_text())
    (tmp_path / "make.toml").write_text(study_text(study={"trials": 1}, cell={"file": "cell.toml"}, range={"cells": "cells"}))
    (tmp_path / "pulses.csv").write_bytes(PULSES.read_bytes())
    (tmp_path / "many.toml").write_text('[campaign]\nconfigs = ["study.toml"]\nseeds = [0]\n')
    (tmp_path / "slow.csv").write_bytes(PULSES.read_bytes())
    (tmp_path / "link.html").symlink_to("charge.sqlite")
    (tmp_path / "hard.html").hardlink_to(tmp_path / "charge.sqlite")
    return tmp_path


def contents(folder):
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in folder.rglob("*")
        if p.is_file() and not p.name.endswith(("-wal", "-shm", "-lock"))
    }


@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("report charge.sqlite --no-evaluate -o charge.sqlite", "--output"),
        ("report charge.sqlite --no-evaluate -o link.html --overwrite", "--output"),
        ("report charge.sqlite --no-evaluate -o hard.html --overwrite", "--output"),
        ("report charge.sqlite --no-evaluate -o charge.sqlite-wal", "--output"),
        ("report charge.sqlite --no-evaluate -o study.toml --overwrite", "--output"),
        ("report charge.sqlite --no-evaluate -o absent/page.html", "--output"),
        ("tune make.toml --store cells/0.toml", "--store"),
        ("report charge.sqlite --no-evaluate -o study.toml/page.html", "--output"),
        ("identify pulses.csv -o pulses.csv --overwrite", "--output"),
        ("identify pulses.csv -o cell.toml", "--output"),
        ("identify pulses.csv -o study.toml --overwrite", "--output"),
        ("identify pulses.csv -o new.toml --figure pulses.csv/x.png", "--figure"),
        ("identify pulses.csv -o slow.csv --ocv slow.csv", "--output"),
        ("certify charge.sqlite --trial 0 --episodes 1000000000 -o study.toml/c.json", "--output"),
        ("compare study.toml --figure charge.sqlite --overwrite", "--figure"),
        ("compare study.toml --figure cell.png/x.png", "--figure"),
        ("tune study.toml --store cell.toml", "--store"),
        ("tune study.toml --store study.toml", "--store"),
        ("tune study.toml --store s.sqlite --out study.toml", "--out"),
        ("campaign many.toml --store study.toml", "--store"),
        ("init cell.toml --cell cell.toml --overwrite", "study file"),
        ("init charge.sqlite --overwrite", "study file"),
        ("store salvage charge.sqlite hard.html", "NEW"),
        ("store export charge.sqlite --out study.toml", "--out"),
        ("report charge.sqlite --no-evaluate --figures study.toml", "--figures"),
        ("simulate study.toml --figure cell.toml --overwrite", "--figure"),
        ("simulate study.toml --figure x.jpg", "--figure"),
        ("simulate study.toml --out study.toml", "--out"),
        ("check study.toml --figures study.toml", "--figures"),
        ("reproduce model --seeds 0:1 --out study.toml", "--out"),
        ("compare study.toml --figure x.jpg", "--figure"),
        ("identify pulses.csv -o new.toml --figure x.jpg", "--figure"),
    ],
)
def test_what_is_refused_changes_no_file_and_names_the_option(folder, command, option):
    before = contents(folder)
    said = chargetune(*command.split(), cwd=folder, code=2).stderr
    assert said.startswith(f"chargetune: {option} ")
    assert contents(folder) == before


def test_a_certificate_is_replaced_only_when_asked(folder):
    certify = ["certify", "charge.sqlite", "--trial", "0", "--episodes"]
    chargetune(*certify, 1, cwd=folder)
    first = contents(folder)
    # So many would take days: it is refused before.
    assert "exists; --overwrite replaces it" in chargetune(*certify, 10**9, cwd=folder, code=2).stderr
    assert contents(folder) == first
    chargetune(*certify, 2, "--overwrite", cwd=folder)
    assert json.loads((folder / "charge-certificate.json").read_text())["figures"]["episodes"] == 2
    # Its figure alone is another file's.
    (folder / "charge-certificate.json").unlink()
    (folder / "charge-certificate.png").write_text("a note\n")
    said = chargetune(*certify, 10**9, "--overwrite", cwd=folder, code=2).stderr
    assert "charge-certificate.png: there is a text file" in said


def test_the_folder_of_a_study_is_renewed_by_it_alone(folder):
    tune = ["tune", "study.toml", "--store", "s.sqlite", "--out", "out", "--json"]
    chargetune(*tune, cwd=folder)
    chargetune(*tune, "--trials", 2, cwd=folder)
    other = folder / "other.toml"
    other.write_text(study_text(study={"name": "other", "trials": 1}))
    said = chargetune("tune", other, "--store", "s.sqlite", "--out", "out", cwd=folder, code=2).stderr
    assert "summary.json: exists; --overwrite replaces it" in said
    chargetune("tune", other, "--store", "s.sqlite", "--out", "out", "--overwrite", cwd=folder)
    assert json.loads((folder / "out" / "summary.json").read_text())["study"] == "other"


def test_tables_are_replaced_only_when_asked(folder):
    export = ["store", "export", "charge.sqlite", "--out", "tables", "--format", "csv"]
    chargetune(*export, cwd=folder)
    assert "exists; --overwrite" in chargetune(*export, cwd=folder, code=2).stderr
    chargetune(*export, "--overwrite", cwd=folder)
    trials = next((folder / "tables").glob("*/trials.csv"))
    trials.write_bytes((folder / "charge.sqlite").read_bytes())
    assert "there is a store" in chargetune(*export, "--overwrite", cwd=folder, code=2).stderr


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"SQLite format 3\0 and more", Kind.STORE),
        (b"\x89PNG\r\n\x1a\n", Kind.PNG),
        (b"%PDF-1.4", Kind.PDF),
        (b'<?xml version="1.0"?>\n<svg width="1">', Kind.SVG),
        (b"\n<!DOCTYPE html><p>", Kind.PAGE),
        (b'{"a": 1}', Kind.JSON),
        (b'{"figures": {}, "traces": {}, "confidence": 0.9}', Kind.CERTIFICATE),
        (b"capacity_Ah = 3.0", Kind.CELL),
        (b"[study]\nseed = 1", Kind.STUDY),
        (b'[campaign]\nconfigs = ["a.toml"]', Kind.CAMPAIGN),
        (b"PAR1", Kind.PARQUET),
        (b"time,current\n1,2", Kind.CSV),
        (b"Spannung \xb5V\n", Kind.CSV),
        (b"\x00\x01", Kind.OTHER),
        (b"", Kind.EMPTY),
    ],
)
def test_a_kind_is_known_by_the_content(tmp_path, content, kind):
    path = tmp_path / "file.html"
    path.write_bytes(content)
    assert kind_of(path) is kind


def test_an_archive_of_traces_is_known(tmp_path):
    np.savez(tmp_path / "t.npz", a=np.zeros(2))
    assert kind_of(tmp_path / "t.npz") is Kind.TRACES


def test_two_outputs_are_two_files_and_a_pipe_is_no_loss(tmp_path):
    one = Output("--output", tmp_path / "a.png", Kind.PNG)
    with pytest.raises(ValueError, match="--output is written to the same file"):
        claim([one, Output("--figure", tmp_path / "." / "a.png", Kind.PNG)], inputs=[], overwrite=True)
    with pytest.raises(ValueError, match="is a folder"):
        claim([Output("--output", tmp_path, Kind.PNG)], inputs=[], overwrite=True)
    claim([one, Output("--output", Path("/dev/null"), Kind.PNG)], inputs=["postgresql://a@b/c"], overwrite=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no device that is always full")  # noqa: PTH110
def test_an_error_while_writing_names_the_file(tmp_path):
    with pytest.raises(OSError, match="/dev/full"):
        write_whole("/dev/full", "x")
    (tmp_path / "file").write_text("")
    for attempt in (try_whole, lambda path: write_whole(path, "x")):
        with pytest.raises(NotADirectoryError) as raised:
            attempt(tmp_path / "file" / "page.html")
        assert raised.value.filename == str(tmp_path / "file" / "page.html")
    name = tmp_path / ("n" * 254)
    with pytest.raises(OSError, match="nnn"):
        try_whole(name)


@pytest.mark.parametrize("command", ["show charge.sqlite", "store check charge.sqlite", "report charge.sqlite --no-evaluate"])
def test_reading_leaves_no_file_beside_the_store(folder, command):
    place = folder / "alone"
    place.mkdir()
    store = place / "charge.sqlite"
    store.write_bytes((folder / "charge.sqlite").read_bytes())
    before = store.read_bytes()
    chargetune(*command.split(), cwd=place)
    assert {p.name for p in place.iterdir()} <= {"charge.sqlite", "charge.html"}
    assert store.read_bytes() == before
