import json

import numpy as np
import pytest
from report_studies import CUT

from chargetune.episode.episode import Ending, Episode
from chargetune.report import read_study
from chargetune.report.page.plot_data import profiles, rounded, signals, thin, trial_drawing


@pytest.fixture(scope="module")
def view(stores):
    return read_study(stores["mixed"], "charge")


def drawn(view, number, **options):
    (reading,) = view.readings([view.trials[number]])
    return trial_drawing(view, reading, **options)


def test_signals_are_those_of_the_trace(view):
    episode = view.episode(view.tuned)
    panels = {p["key"]: p for p in signals(view.problem, episode)}
    assert list(panels) == ["soc", "current_A", "voltage_V", "near"]
    np.testing.assert_allclose(panels["soc"]["y"][1:], 100 * episode.signal("soc")[1], rtol=1e-5)
    np.testing.assert_allclose(panels["current_A"]["y"][::2], episode.input[:, 0], rtol=1e-5, atol=1e-9)
    start, end = episode.signal("voltage_V")
    np.testing.assert_allclose(panels["voltage_V"]["y"][::2], start, rtol=1e-5)
    np.testing.assert_allclose(panels["voltage_V"]["y"][1::2], end, rtol=1e-5)
    np.testing.assert_allclose(panels["voltage_V"]["x"][1::2], (episode.time_s + 10) / 60, rtol=1e-5)
    assert panels["current_A"]["limits"] == [6.0]
    assert panels["voltage_V"]["limits"] == [2.5, 4.2]
    assert (panels["near"]["of"], panels["near"]["y"], panels["near"]["limits"]) == ("voltage_V", [], [4.2])


@pytest.mark.parametrize(("number", "points", "message"), [(3, 2 * CUT, ""), (6, 0, "no trace is stored")])
def test_failed_trials(view, number, points, message):
    drawing = drawn(view, number)
    panels = {p["key"]: p for p in drawing["panels"]}
    assert len(panels.get("voltage_V", {"y": []})["y"]) == points
    assert drawing["message"] == message
    assert list(drawing["theta"].values()) == list(view.trials[number].theta)
    json.dumps(drawing, allow_nan=False)


def test_profiles_pass_through_their_nodes(view):
    theta = np.array(view.tuned.theta)
    found = {p["key"]: p for p in profiles(view, theta)}
    assert list(found) == ["backoff", "R0", "R1"]
    np.testing.assert_allclose(found["backoff"]["nodes_y"], 1e3 * theta[view.space.slices["backoff_V"]], rtol=1e-4)
    belief = 1e3 * np.array(view.problem.controller_cell.R1_ohm) * theta[view.space.slices["R1_ratio"]]
    np.testing.assert_allclose(found["R1"]["nodes_y"], belief, rtol=1e-4)
    for profile in found.values():
        np.testing.assert_allclose(np.interp(profile["nodes_x"], profile["x"], profile["y"]), profile["nodes_y"], rtol=0.01, atol=0.5)
    true = 1e3 * np.array(view.problem.cell.R1_ohm)
    beside = found["R1"]["beside"]
    np.testing.assert_allclose(np.interp(100 * np.array(view.problem.cell.soc), beside["x"], beside["y"]), true, rtol=0.01)


def test_another_system_shows_every_input_and_output():
    k = 4
    episode = Episode(
        0.5, ("force",), ("angle", "speed"), ("N",), ("rad", "m/s"), (), np.arange(k) * 0.5, np.arange(k, dtype=float)[:, None],
        np.zeros((k, 2)), np.ones((k, 2)), np.zeros((k, 0)), np.zeros(k, int), np.zeros(k), np.zeros(k, int), Ending.DONE,
    )  # fmt: skip
    panels = signals(None, episode)
    assert [p["label"] for p in panels] == ["force (N)", "angle (rad)", "speed (m/s)"]
    assert panels[0]["x"] == [0.0, 0.5, 0.5, 1.0, 1.0, 1.5, 1.5, 2.0]
    assert panels[0]["y"] == [0, 0, 1, 1, 2, 2, 3, 3]
    assert panels[1]["y"] == [0, 1] * 4
    assert {p["time"] for p in panels} == {"time (s)"}


@pytest.mark.parametrize("points", [10, 99, 1000])
def test_thin_keeps_the_ends_and_the_extremes(points):
    rng = np.random.default_rng(0)
    x = np.arange(5000.0)
    y = rng.normal(size=5000)
    y[1234], y[4321], y[77] = 50.0, -50.0, np.nan
    few_x, few_y = thin(x, y, points)
    assert len(few_x) <= points
    assert (few_x[0], few_x[-1]) == (0.0, 4999.0)
    assert (50.0 in few_y, -50.0 in few_y) == (True, True)
    assert np.all(np.diff(few_x) > 0)
    np.testing.assert_array_equal(few_y, y[few_x.astype(int)])


def test_thin_leaves_a_short_curve_alone():
    x = np.arange(5.0)
    assert thin(x, x, 5)[0] is x


def test_what_is_no_number_is_none():
    assert rounded(np.array([1 / 3, np.nan, np.inf, 1e-9])) == [0.333333, None, None, 1e-9]
