"""Tune the crane of custom_system.py once, for every rope and every start that it will meet.

The range of use says what differs: the rope, what hangs on it before the move, and where the move begins. Each trial is one theta on
300 fresh cranes; the next one is chosen on those that came nearest to the limit. Run: python examples/range_crane.py [TRIALS]
"""

import sys

from custom_system import CONTROLLER, LIMITS, SPACE, STEPS, closeness, crane

import chargetune as ct

NOISE = {"position": 1e-3, "speed": 1e-3, "angle": 1e-4, "turn": 1e-3}
PLANT = ct.SimulatedPlant(crane(1.0), {}, ct.Sensors(noise_sd=NOISE))
RANGE = ct.RangeOfUse(PLANT, (
    ct.Variation("rope", ct.Uniform(-0.2, 0.2), parameters={"rope_m": 1.0}),
    ct.Variation("start", ct.Uniform(-0.3, 0.3), starts={"position": 1.0}, of="episode"),
    ct.Variation("swinging load", ct.Normal(0.0, 0.01), starts={"angle": 1.0}, of="episode")))  # fmt: skip
LOOP = ct.SimulatedRange(CONTROLLER, RANGE, STEPS, tuple(LIMITS), closeness)


def tune(trials, plants, path, settings=None):
    """The trials of a study in this file, and its result."""
    evaluation = ct.RangeEvaluation(LOOP, plants)
    tuner = ct.RangeTuner(evaluation, seed=0, settings=settings or ct.RangeSettings())
    study = {"config": {"system": "crane", "range": "ropes, starts and loads"}, "space": SPACE, "tuner": tuner}
    with ct.Store(path) as store, ct.Study.create_or_resume(store, "cranes", **study) as tuning:
        best = tuning.run(evaluation, trials)
        return tuning.trials(), best


def main(trials):
    """Tune in range_crane.sqlite and print what each theta did."""
    for trial in tune(trials, 300, "range_crane.sqlite")[0]:
        values = ", ".join(f"{name} = {value:.3g}" for name, value in zip(SPACE.entries, trial.theta, strict=True))
        broke, of = (int(trial.score.metrics[name]) for name in ("violating_plants", "plants"))
        print(f"trial {trial.number}: {broke} of {of} cranes swing too far, objective {trial.score.objective:.3f} m s, {values}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
