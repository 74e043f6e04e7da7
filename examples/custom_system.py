"""Tune an MPC for a system that is no battery: an overhead crane moves its load 2 m without letting it swing too far.

The controller believes in a rope of 0.6 m, the crane has 1.0 m, so the load swings beyond its limit. theta has one entry in
the cost (weight of the swing) and one in the model (rope length). Run: python examples/custom_system.py [TRIALS]
"""

import sys

import casadi as ca
import matplotlib.pyplot as plt

import chargetune as ct

TS, STEPS, SWING_MAX_RAD = 0.1, 80, 0.10


def crane(rope_m):
    """Trolley acceleration a moves position and, through the rope, the angle: angle'' = -(g sin(angle) + a cos(angle)) / rope."""

    def equations(x, u, p):
        def rate(state):
            _, speed, angle, turn = ca.vertsplit(state)
            swing = -(9.81 * ca.sin(angle) + u["acceleration"] * ca.cos(angle)) / p["rope_m"]
            return ca.vertcat(speed, u["acceleration"], turn, swing - 0.05 * turn)

        return dict(zip(x, ca.vertsplit(ct.rk4(rate, x.vector, TS, substeps=2)), strict=True)), x

    states = [ct.Signal("position", "m"), ct.Signal("speed", "m/s"), ct.Signal("angle", "rad"), ct.Signal("turn", "rad/s")]
    return ct.Model.build("crane", states=states, inputs=[ct.Signal("acceleration", "m/s2")], outputs=states,
                          parameters={"rope_m": rope_m}, sampling_time_s=TS, equations=equations)  # fmt: skip


SPACE = ct.ParameterSpace((ct.Parameter("swing_weight", 1e-2, 1e2, default=0.1, scale="log"),
                           ct.Parameter("rope_m", 0.5, 2.0, default=0.6, unit="m")))  # fmt: skip
CONTROLLER = ct.Controller.build(
    crane(0.6), SPACE, horizon=20, parameters=lambda s: {"rope_m": s.theta["rope_m"]},
    stage_cost=lambda s: ((s.x["position"] - 2) ** 2 + 0.1 * s.x["speed"] ** 2 + 0.01 * s.u["acceleration"] ** 2
                          + s.theta["swing_weight"] * s.x["angle"] ** 2),
    terminal_cost=lambda s: 10 * ((s.x["position"] - 2) ** 2 + s.x["speed"] ** 2),
    input_lower={"acceleration": -1.0}, input_upper={"acceleration": 1.0}, fallback={"acceleration": 0.0},
    limits=[ct.SoftLimit("angle", lower=-SWING_MAX_RAD, upper=SWING_MAX_RAD, penalty=1e4, scale=0.1)])  # fmt: skip
LIMITS = [ct.ScoredLimit("angle", lower=-SWING_MAX_RAD, upper=SWING_MAX_RAD, tolerance=1e-3)]


def closeness(episode):
    """Minus the distance still to go, integrated over the move, m s."""
    return -TS * float(abs(2.0 - episode.signal("position")[1]).sum())


def evaluate(theta, seed):
    """One move of the real crane, and its score."""
    episode = ct.simulate(CONTROLLER, ct.SimulatedPlant(crane(1.0), {}), steps=STEPS, theta=theta, seed=seed)
    return ct.score_limits(episode, LIMITS, objective=closeness, penalty=0.1)


def main(trials):
    """Tune in crane.sqlite, where a second run goes on, and draw the untuned and the best move in crane.pdf."""
    study = {"config": {"system": "crane"}, "space": SPACE, "tuner": ct.ConstrainedLogEI(seed=0)}
    with ct.Store("crane.sqlite") as store, ct.Study.create_or_resume(store, "crane", **study) as tuning:
        best = tuning.run(evaluate, trials)
    for name, theta in [("untuned", SPACE.default), *([("tuned", best.theta)] if best else [])]:
        score, episode, ending = evaluate(theta, seed=0)
        print(f"{name}: {ending}, objective {score.objective:.3f} m s, swing beyond its limit {score.excess['angle']:.3f} rad")
        plt.plot(episode.time_s, episode.signal("angle")[1], label=f"{name}: swing (rad)")
    plt.legend()
    plt.savefig("crane.pdf")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 25)
