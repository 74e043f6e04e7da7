"""Closed loops of the literature's systems, compared with IPOPT on the same expressions and with do-mpc where it is installed.

    python benchmarks/generic.py [--json] [--only NAME ...] [--step-by-step]

By default each episode is one compiled function; its set-up (by the C compiler) is told apart. ``--step-by-step`` runs the same solver
without a compiler. Each row holds the largest difference of inputs and of states as a share of their range over IPOPT's
episode, the tolerance of the inputs, the shares of steps not solved, milliseconds an episode and the ratio of speed. All is of one run.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from chargetune.control.ipopt_reference import ipopt_act
from chargetune.episode.compiled import compiled_episode
from chargetune.episode.stepwise import run_episode

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
import mpc_systems
from generic_do_mpc import by_do_mpc

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
    of_inputs, of_states = of_range(own.input, other.input), of_range(own.state, other.state)
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
    peer = by_do_mpc(case)
    if peer is not None:
        states, inputs, peer_seconds = peer
        row["input_difference_do_mpc"] = of_range(own.input, inputs)
        row["state_difference_do_mpc"] = of_range(own.state, states)
        row["ratio_do_mpc"] = peer_seconds / seconds
    return row


def of_range(one, two):
    """The largest difference as a share of the second one's range, over all columns."""
    return float(np.max(np.abs(one - two) / (np.ptp(two, axis=0) + 1e-12)))


def timed(run, repeats):
    """(the last result, the shortest time in seconds)."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        result = run()
        times.append(time.perf_counter() - begin)
    return result, min(times)


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
                + (
                    "; do-mpc: inputs {input_difference_do_mpc:.1e}, states {state_difference_do_mpc:.1e}, {ratio_do_mpc:.0f} x".format(
                        **rows[-1]
                    )
                    if "ratio_do_mpc" in rows[-1]
                    else ""
                ),
                flush=True,
            )
    if asked.json:
        print(json.dumps({"rows": rows}))


if __name__ == "__main__":
    main()
