"""Pieces of a CasADi vector: columns whatever their lengths."""

import casadi as ca
import pytest

from chargetune.model.model import Model, Named, Signal
from chargetune.runtime.split import split


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@pytest.mark.parametrize("sizes", [(), (0,), (1,), (0, 1), (1, 0), (0, 1, 0), (2, 0, 1), (0, 0)])
def test_pieces_are_columns_that_stand_below_each_other(kind, sizes):
    vector = kind.sym("v", sum(sizes))
    pieces = split(vector, sizes)
    assert [piece.shape for piece in pieces] == [(size, 1) for size in sizes]
    again = ca.Function("again", [vector], [ca.vertcat(kind(0, 1), *pieces)])
    assert ca.DM(again(range(sum(sizes)))).full().ravel().tolist() == list(range(sum(sizes)))


def test_pieces_that_are_not_all_are_refused():
    with pytest.raises(RuntimeError, match="must equal the number"):
        split(ca.SX.sym("v", 3), (1, 1))


def test_a_block_without_a_number_beside_one_with_one():
    named = Named({"a": 1, "b": 0}, ca.SX.sym("v", 1))
    assert (named["a"].shape, named["b"].shape) == ((1, 1), (0, 1))
    own = Model.build(
        "m", states=(Signal("x"),), inputs=(Signal("u"),), outputs=(), parameters={"gain": 2.0, "table": []}, sampling_time_s=1.0,
        equations=lambda x, u, p: ({"x": x["x"] + p["gain"] * u["u"] + ca.sum1(ca.vertcat(p["table"], p["gain"]))}, {}),
    )  # fmt: skip
    assert float(own.f(1.0, 3.0, own.nominal)) == 9.0
