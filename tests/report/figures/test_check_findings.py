"""Figures of findings and of a certificate show the numbers they are about."""

import json

import numpy as np
import pytest

from chargetune.checks.finding import Evidence, Finding
from chargetune.report.figures.certificate import certificate_figure
from chargetune.report.figures.check_findings import finding_figure, save_findings

X = np.arange(5.0)
CURVES = Evidence("x", "y", {"a": (X, X**2), "b": (X, -X)}, {"limit": 3.0})
SHOWN = Finding("short-horizon", "warning", "message with $ in it", "do", {}, CURVES)
BARE = Finding("unsafe-start", "error", "message", "do", {})


def test_a_finding_is_drawn_with_every_line_and_bound(tmp_path):
    (axis,) = finding_figure(SHOWN).axes
    first, second, bound = axis.lines
    np.testing.assert_array_equal(first.get_ydata(), X**2)
    np.testing.assert_array_equal(second.get_ydata(), -X)
    assert set(bound.get_ydata()) == {3.0}
    assert [p.name for p in save_findings([BARE, SHOWN], tmp_path / "f")] == ["2-short-horizon.png"]
    with pytest.raises(ValueError, match="no curves"):
        finding_figure(BARE)


def test_the_page_of_a_certificate_shows_each_episode(tmp_path):
    """Three episodes of two intervals: 4.21, 4.19 and 4.30 V at worst; SOC 0.8 after 15 s, never, after 20 s."""
    arrays = {
        "length": np.array([2, 2, 2]),
        "completed": np.array([True, True, True]),
        "soc_start": np.array([0.7, 0.5, 0.6]),
        "start.voltage_V": np.array([4.1, 4.2, 4.1, 4.1, 4.3, 4.1]),
        "end.voltage_V": np.array([4.21, 4.2, 4.15, 4.19, 4.1, 4.1]),
        "end.soc": np.array([0.75, 0.85, 0.6, 0.7, 0.7, 0.8]),
    }
    np.savez_compressed(tmp_path / "c.npz", **arrays)
    limit = {"name": "voltage_max_V", "signal": "voltage_V", "upper": True, "bound": 4.2, "tolerance": 0.0005}
    low = {"name": "anode_min_V", "signal": "soc", "upper": False, "bound": 0.65, "tolerance": 0.001}
    stated = {
        "traces": {"file": "c.npz"}, "limits": [limit], "sampling_time_s": 10.0, "confidence": 0.95, "origin": {},
        "cell": {"name": "cell", "remark": ""}, "figures": {"episodes": 3, "violations": 2, "violation_probability_upper": 0.98},
    }  # fmt: skip
    (tmp_path / "c.json").write_text(json.dumps(stated))
    excess, times = certificate_figure(tmp_path / "c.json").axes
    np.testing.assert_allclose(excess.lines[0].get_ydata(), [-10.0, 10.0, 100.0], atol=1e-9)
    np.testing.assert_allclose(excess.lines[0].get_xdata(), [100 / 3, 200 / 3, 100.0])
    np.testing.assert_allclose(times.lines[0].get_ydata(), [15 / 60, 20 / 60, np.nan], atol=1e-9)

    arrays["start.soc"] = np.array([0.7, 0.75, 0.5, 0.6, 0.6, 0.7])
    np.savez_compressed(tmp_path / "c.npz", **arrays)
    (tmp_path / "c.json").write_text(json.dumps(stated | {"limits": [low]}))
    np.testing.assert_allclose(certificate_figure(tmp_path / "c.json").axes[0].lines[0].get_ydata(), [-50.0, 50.0, 150.0], atol=1e-9)

    # What differs has a column of its own, what does not has none; crosses are the episodes over the limit, dots the others.
    arrays |= {
        "drawn.soc_start": arrays["soc_start"][:, None],
        "drawn.age": np.array([[0.1], [0.9], [0.4]]),
        "drawn.ambient_K": np.full((3, 1), 290.0),
    }
    arrays["completed"] = np.array([True, False, True])
    np.savez_compressed(tmp_path / "c.npz", **arrays)
    (tmp_path / "c.json").write_text(json.dumps(stated))
    axes = certificate_figure(tmp_path / "c.json").axes
    assert [axis.get_xlabel() for axis in axes[3:]] == ["episodes (%)", "SOC at the start (%)", "age (% of full)"]
    kept, over = axes[1].lines[1:]
    np.testing.assert_allclose([kept.get_xdata(), kept.get_ydata()], [[50.0], [-10.0]], atol=1e-9)
    np.testing.assert_allclose([over.get_xdata(), over.get_ydata()], [[70.0, 60.0], [10.0, 100.0]], atol=1e-9)
    # One that did not come to its end violates, too.
    assert axes[5].lines[0].get_xdata().size == 0
    np.testing.assert_allclose(axes[5].lines[1].get_xdata(), [10.0, 90.0, 40.0])
