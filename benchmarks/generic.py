"""Closed loops of the literature's systems, compared with IPOPT on the same expressions and, where it is written, with do-mpc.

    python benchmarks/generic.py [--json] [--only NAME ...] [--step-by-step]

By default each episode is one compiled function; its set-up (by the C compiler) is told apart. ``--step-by-step`` runs the same solver
without a compiler. Each row holds the largest difference of inputs and of states as a share of their range over IPOPT's
episode, the tolerance of the inputs, the shares of steps not solved, milliseconds an episode and the ratio of speed. All is of one run.
"""

import argparse
import json
import sys
import time
import warnings
from pathlib import Path

import casadi as ca
import numpy as np

from chargetune.control.ipopt_reference import ipopt_act
from chargetune.episode.compiled import compiled_episode
from chargetune.episode.stepwise import run_episode

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
import mpc_systems

REPEATS = 3


def compared(case, *, step_by_step):
    """One row."""
    begin = time.perf_counter()
    if step_by_step:

        def run():
            return run_episode(case.controller, case.plant, steps=case.steps, given=case.given)

        run()
    else:
        whole = compiled_episode(case.controller, case.plant, case.steps)

        def run():
            return whole.run(given=case.given)

    set_up = time.perf_counter() - begin
    own, seconds = timed(run, REPEATS)
    other, other_seconds = timed(lambda: run_episode(case.controller, case.plant, steps=case.steps, given=case.given, control=ipopt_act), 1)
    of_inputs, of_states = (
        float(np.max(np.abs(one - two) / (np.ptp(two, axis=0) + 1e-12)))
        for one, two in ((own.input, other.input), (own.state, other.state))
    )
    row = {
        "system": case.name,
        "hessian": case.controller.hessian,
        "input_difference": of_inputs,
        "state_difference": of_states,
        "tolerance": case.tolerance,
        "equal": of_inputs <= case.tolerance,
        "unsolved_percent": 100 * own.unsolved_share,
        "unsolved_percent_ipopt": 100 * other.unsolved_share,
        "set_up_s": set_up,
        "episode_ms": 1e3 * seconds,
        "ratio_ipopt": other_seconds / seconds,
    }
    peer = by_do_mpc(case) if case.name == "oscillating masses" else None
    if peer is not None:
        states, peer_seconds = peer
        row["state_difference_do_mpc"] = float(np.max(np.abs(own.state - states) / np.ptp(states, axis=0)))
        row["ratio_do_mpc"] = peer_seconds / seconds
    return row


def timed(run, repeats):
    """(the last result, the shortest time in seconds)."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        result = run()
        times.append(time.perf_counter() - begin)
    return result, min(times)


def by_do_mpc(case):
    """(states, seconds) of the oscillating masses by do-mpc; None where it is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import do_mpc
    except ImportError:
        return None
    own = case.controller.model
    model = do_mpc.model.Model("discrete", "SX")
    state, u = model.set_variable("_x", "x", shape=(4, 1)), model.set_variable("_u", "u")
    model.set_rhs("x", own.f(state, u, []))
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    quiet = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes"}
    mpc.set_param(n_horizon=case.controller.horizon, t_step=own.sampling_time_s, store_full_solution=False, nlpsol_opts=quiet)
    mpc.set_objective(lterm=ca.sumsqr(model.x["x"]), mterm=ca.sumsqr(model.x["x"]))
    mpc.set_rterm(u=1e-4)
    mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = -0.5, 0.5
    mpc.bounds["lower", "_x", "x"], mpc.bounds["upper", "_x", "x"] = -4.0, 4.0
    mpc.setup()
    x = case.plant.start_state
    mpc.x0 = x
    mpc.set_initial_guess()
    states, begin = [x], time.perf_counter()
    for _ in range(case.steps):
        x = np.array(own.f(x, mpc.make_step(x.reshape(-1, 1)), [])).ravel()
        states.append(x)
    return np.array(states), time.perf_counter() - begin


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--step-by-step", action="store_true")
    parser.add_argument("--only", nargs="*", default=[make.__name__ for make in mpc_systems.CASES])
    asked = parser.parse_args()
    rows = []
    for make in mpc_systems.CASES:
        if make.__name__ not in asked.only:
            continue
        rows.append(compared(make(), step_by_step=asked.step_by_step))
        if not asked.json:
            print(
                "{system:20s} {hessian:13s} inputs {input_difference:.1e} (tolerance {tolerance:.0e}), states {state_difference:.1e}, "
                "not solved {unsolved_percent:.0f} %, set-up {set_up_s:.0f} s, {episode_ms:.1f} ms, {ratio_ipopt:.0f} x IPOPT".format(
                    **rows[-1]
                )
                + (f", {rows[-1]['ratio_do_mpc']:.0f} x do-mpc" if "ratio_do_mpc" in rows[-1] else ""),
                flush=True,
            )
    if asked.json:
        print(json.dumps({"rows": rows}))


if __name__ == "__main__":
    main()
