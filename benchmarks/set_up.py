"""How long it takes until a controller of a given size runs, and how fast it then is. Run: python benchmarks/set_up.py [--json].

A linear system with dense random matrices, every limit a soft one on a state, quadratic costs. Each row is a fresh process with an empty
cache: seconds from the model to the first episode of 100 steps (building, generating C, compiling with the library's flags, running), the
size of the C, and milliseconds an episode afterwards, compiled or on CasADi's virtual machine. ``cpu_s`` is the same in seconds of the
processor, the compiler's included, which others on the machine disturb less. Everything is of one run.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time

import numpy as np

# States, inputs, horizon, soft limits.
SIZES = ((4, 1, 20, 2), (8, 2, 20, 4), (10, 2, 20, 4), (12, 4, 30, 6), (30, 4, 30, 6), (12, 4, 100, 6))
STEPS = 100


def loop(nx, nu, horizon, limits, blocks=None):
    """(controller, plant): a chain of stable modes that all inputs move, started where limits are in the way."""
    from chargetune.control.controller import Controller, SoftLimit
    from chargetune.model.model import Model, Signal
    from chargetune.model.parameter_space import Parameter, ParameterSpace
    from chargetune.plants.simulated import SimulatedPlant

    draw = np.random.default_rng(0)
    a = draw.normal(size=(nx, nx))
    a *= 0.97 / np.max(np.abs(np.linalg.eigvals(a)))
    b = draw.normal(size=(nx, nu))
    states, inputs = [f"x{i}" for i in range(nx)], [f"u{i}" for i in range(nu)]

    def equations(x, u, _):
        after = {name: sum(a[i, j] * x[s] for j, s in enumerate(states)) for i, name in enumerate(states)}
        for i, name in enumerate(states):
            after[name] += sum(b[i, j] * u[s] for j, s in enumerate(inputs))
        return after, {name: x[name] for name in states}

    model = Model.build(
        "linear",
        states=[Signal(s) for s in states],
        inputs=[Signal(s) for s in inputs],
        outputs=[Signal(s) for s in states],
        parameters={},
        sampling_time_s=1.0,
        equations=equations,
    )
    controller = Controller.build(
        model,
        ParameterSpace((Parameter("r", 0.01, 1.0, 0.1),)),
        horizon=horizon,
        stage_cost=lambda s: sum((s.x[name] - 0.5) ** 2 for name in states) + s.theta["r"] * sum(s.u[name] ** 2 for name in inputs),
        terminal_cost=lambda s: 5 * sum((s.x[name] - 0.5) ** 2 for name in states),
        input_lower=dict.fromkeys(inputs, -0.5),
        input_upper=dict.fromkeys(inputs, 0.5),
        limits=[SoftLimit(states[i], upper=0.6, penalty=1e3, scale=0.1) for i in range(limits)],
        **({} if blocks is None else {"blocks": blocks}),
    )
    plant = SimulatedPlant(model=model, start=dict.fromkeys(states, 1.0))
    return controller, plant


def measure(nx, nu, horizon, limits, compiled):
    """One row, in this process."""
    import chargetune.episode.compiled as episode

    size, compile_library = [0.0], episode.compile_library

    def counted(name, sources, defines=()):
        size[0] = sum(len(source) for source in sources) / 1e6
        return compile_library(name, sources, defines)

    episode.compile_library = counted
    begin = time.perf_counter()
    own = episode.compiled_episode(*loop(nx, nu, horizon, limits), STEPS, compiled=compiled)
    first = own.run()
    ready = time.perf_counter() - begin
    spent = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    times = []
    while len(times) < 3 or sum(times) < 1.0:
        begin = time.perf_counter()
        own.run()
        times.append(time.perf_counter() - begin)
    return {
        "nx": nx,
        "nu": nu,
        "N": horizon,
        "limits": limits,
        "compiled": compiled,
        "c_mb": round(size[0], 3) if compiled else None,
        "first_episode_s": round(ready, 2),
        "cpu_s": round(sum(one.ru_utime + one.ru_stime for one in spent), 2),
        "episode_ms": round(1e3 * statistics.median(times), 3),
        "unsolved": int(np.sum(first.status != 0)),
    }


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print JSON for a program")
    parser.add_argument("--row", help=argparse.SUPPRESS)
    parser.add_argument("--only", type=int, nargs=4, metavar=("NX", "NU", "N", "LIMITS"), help="measure one size")
    arguments = parser.parse_args()
    if arguments.row:
        print(json.dumps(measure(*json.loads(arguments.row))))
        return
    rows = []
    for size in [tuple(arguments.only)] if arguments.only else SIZES:
        for compiled in (True, False):
            with tempfile.TemporaryDirectory() as folder:
                command = [sys.executable, __file__, "--row", json.dumps([*size, compiled])]
                environment = {**os.environ, "CHARGETUNE_CACHE": folder}
                done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
            rows.append(json.loads(done.stdout))
            if not arguments.json:
                print(rows[-1], flush=True)
    if arguments.json:
        print(json.dumps({"rows": rows}))


if __name__ == "__main__":
    main()
