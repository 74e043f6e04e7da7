import re
import shutil
import struct
import sys

import matplotlib as mpl
import pytest

from chargetune.episode.score import Score
from chargetune.model.parameter_space import Parameter, ParameterSpace
from chargetune.report import figures_of, read_study, save_figures
from chargetune.report.figures.convergence import convergence_figure
from chargetune.report.figures.style import COLUMN_IN, PAGE_IN, save
from chargetune.study.store.store import Store, StoreError
from chargetune.study.study import Study

ALL = ["trajectories", "backoff", "R0", "R1", "convergence"]


@pytest.mark.parametrize(("kind", "names"), [("mixed", ALL), ("violating", ALL), ("ei", ALL), ("failed", ALL[1:])])
def test_every_kind_of_study_is_drawn(stores, kind, names):
    figures = figures_of(read_study(stores[kind], "charge"))
    assert list(figures) == names
    for figure in figures.values():
        figure.canvas.draw()
        box = figure.legends[0].get_window_extent()
        assert box.x0 >= 0, "the legend is cut off"
        assert box.x1 <= figure.bbox.x1, "the legend is cut off"
        assert box.y1 <= figure.bbox.y1, "the legend is cut off"


def test_every_figure_in_every_format(files):
    assert list(files) == [f"{name}.{kind}" for name in ALL for kind in ("png", "pdf", "svg")]


@pytest.mark.parametrize("name", ALL)
def test_png_files_have_the_size_of_a_journal_at_300_dpi(files, name):
    content = files[f"{name}.png"].read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    assert content[-8:-4] == b"IEND"
    width, height = struct.unpack(">II", content[16:24])
    assert width == 300 * (PAGE_IN if name == "trajectories" else COLUMN_IN)
    assert 600 < height < 1500
    assert 20_000 < len(content) < 1_500_000


@pytest.mark.parametrize("name", ALL)
def test_vector_files_have_the_width_of_a_journal(files, name):
    for file in (files[f"{name}.pdf"], files[f"{name}.svg"]):
        content = file.read_bytes()
        assert len(content) < 1_500_000
        if file.suffix == ".pdf":
            points = 72 * (PAGE_IN if file.stem == "trajectories" else COLUMN_IN)
            assert content.startswith(b"%PDF")
            assert float(re.search(rb"/MediaBox \[ *0 0 ([\d.]+)", content)[1]) == points
            assert b"/Type3" not in content, "journals want TrueType fonts"
        else:
            assert b"<svg" in content[:1000]


def test_the_same_bytes_from_the_store_alone_whatever_the_user_set(stores, files, tmp_path):
    moved = shutil.copy(stores["mixed"], tmp_path / "elsewhere.sqlite")
    with mpl.rc_context({"font.size": 20, "axes.grid": True, "lines.linewidth": 7, "savefig.bbox": "tight", "font.family": "serif"}):
        before = dict(mpl.rcParams)
        again = save_figures(moved, "charge", tmp_path, ("png",))
        again += [save(convergence_figure(read_study(moved, "charge")), tmp_path / f"convergence.{kind}") for kind in ("pdf", "svg")]
        assert dict(mpl.rcParams) == before, "the user's settings are put back"
    assert [f.name for f in again if f.read_bytes() != files[f.name].read_bytes()] == []
    assert len(again) == len(ALL) + 2


def test_all_formats_have_the_same_layout(stores, tmp_path):
    figure = convergence_figure(read_study(stores["mixed"], "charge"))
    places = []
    for kind in ("png", "pdf", "svg", "png"):
        save(figure, tmp_path / f"c.{kind}")
        places.append([axis.get_position().bounds for axis in figure.axes])
    assert all(place == places[0] for place in places)


def test_pyplot_is_not_used(stores, tmp_path):
    sys.modules.pop("matplotlib.pyplot", None)
    save_figures(stores["violating"], "charge", tmp_path)
    assert "matplotlib.pyplot" not in sys.modules


def test_the_first_trials_only(stores):
    figure = convergence_figure(read_study(stores["mixed"], "charge", trials=3))
    assert {x for line in figure.axes[0].lines for x in line.get_xdata()} == {0, 1, 2}


@pytest.mark.parametrize("formats", [("bmp",), (), "png", ("png", "eps")])
def test_formats_are_checked_before_anything_is_written(stores, tmp_path, formats):
    with pytest.raises(ValueError, match=r"formats = .*allowed is a non-empty selection of png, pdf, svg"):
        save_figures(stores["mixed"], "charge", tmp_path / "out", formats)
    assert not (tmp_path / "out").exists()


def test_unknown_study(stores, tmp_path):
    with pytest.raises(StoreError, match=r"no study 'other'; there are: charge"):
        save_figures(stores["mixed"], "other", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_study_that_is_not_about_charging_shows_its_convergence(tmp_path):
    space = ParameterSpace((Parameter("gain", 0.0, 1.0, 0.5),))

    class Corner:
        def ask(self, space, trials, n=1):
            return [[0.5 / (1 + len(trials))]] * n

    def evaluate(theta, seed):
        return Score(-theta[0], -theta[0], {"speed": theta[0] - 0.2}, {"speed": 0.0}), None, "done"

    path = tmp_path / "pendulum.sqlite"
    with Store(path) as store, Study.create_or_resume(store, "pendulum", config={"mass": 1.0}, space=space, tuner=Corner()) as study:
        study.run(evaluate, 4)
    assert [f.name for f in save_figures(path, "pendulum", tmp_path)] == ["convergence.png"]
