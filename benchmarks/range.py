"""One theta for a range of use, and what real charges add to it. Run: python benchmarks/range.py [--rows ...] [--json].

Range R1 is that of examples/range_learn.toml: start SOC 0.05 to 0.5, resistances 20 % in common and 20 % a node, capacitances 20 % a node,
capacity 2 %, age up to R times 1.5 and Q times 0.8, 2 mV of noise, only voltage and current measured. Rows:

R1        no trial: theta chosen in simulation on draws of the range, judged on fresh ones
learn     each of ``--cells`` cells of R1: no charge, then one to ``--charges`` charges, each judged on fresh charges of that cell
crane     examples/range_crane.py, ratio: distance integral to that of a theta tuned for each drawn crane alone
DFN       examples/range_dfn.toml: limits of voltage, temperature and anode potential on PyBaMM's DFN: the declared start over the whole
          range, then each of ``--cells`` cells after ``--charges`` charges, if that is not 0
structural  the plant of benchmarks/learning_plants.py that no circuit is, from SOC 0.05 to 0.4: the first theta is chosen on the circuits
          of R1, the controller's model differs from seed to seed

``--without`` takes one part away: feedback (the estimator is open_loop), range (theta is tuned for the cell as its file has it, judged on
R1), margin (one search on drawn plants, aim at the whole tolerance), discrepancy (the twin is taken as the plant). The oracle keeps every
limit exactly at each interval, on the drawn plant itself; the ratio is that of mean times on the first ``--oracles`` of the draws.
Cells from 100 on were used to choose settings; report on others. tune_s counts the search alone.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from chargetune.battery.baselines.charging_protocols import charge, constant_current
from chargetune.battery.certification.clopper_pearson import violation_bound
from chargetune.battery.charging.charging_range import ChargingRange
from chargetune.battery.charging.controller import controller_of
from chargetune.battery.charging.evaluate import outcome
from chargetune.battery.charging.problem import judged_exactly
from chargetune.battery.charging.range_twin import ChargingRangeTwin, RangeCharge
from chargetune.battery.charging.settings import EstimatorSettings
from chargetune.battery.charging.verdict import score_episode
from chargetune.battery.plants.steppable import as_steppable
from chargetune.battery.studies.study_file import TwinTable, load_config
from chargetune.episode.compiled import compiled_episode
from chargetune.learning import RangeSettings, RangeTwinSettings, RangeTwinTuner, Safety
from chargetune.plants.range_of_use import DrawnPlant

EXAMPLES = Path(__file__).parents[1] / "examples"
ROWS = ("R1", "learn", "crane", "DFN", "structural")
WITHOUT = ("feedback", "range", "margin", "discrepancy")
# A charge of R1 takes at most this at any sampling time.
LONGEST_S = 2400.0


def r1(options, step=None):
    """The problem of R1 at this sampling time."""
    problem = load_config(EXAMPLES / "range_learn.toml").problem()
    step = step or options.step_s
    problem = replace(
        problem,
        controller=replace(problem.controller, sampling_time_s=step),
        episode=replace(problem.episode, steps=round(LONGEST_S / step)),
        range=replace(problem.range, cell=None),
    )
    if "feedback" in options.without:
        theta = replace(problem.theta, observer=())
        problem = replace(problem, estimator=EstimatorSettings(kind="open_loop"), theta=theta)
    return problem


def settings_of(options):
    """Of the search, with the parts that are taken away."""
    first = RangeSettings(plants=options.plants, pool=16, iterations=options.iterations)
    later = RangeSettings(plants=options.plants * 2 // 3, pool=8, iterations=options.iterations)
    rounds, twin = options.rounds, RangeTwinSettings().twin
    if "margin" in options.without:
        first, later, rounds = replace(first, aim=1.0, corners=0), replace(later, aim=1.0, corners=0), 1
    if "discrepancy" in options.without:
        # The median of the scale's prior is 1; without a spread, and a share of next to nothing, it is a tenth.
        twin = replace(twin, scale_sd=10.0, scale_share=0.0)
    return RangeTwinSettings(rounds=rounds, judges=options.judges, first=first, later=later, twin=twin)


def oracle(use, plants):
    """Minutes to 80 % of the largest current that keeps every limit, on each plant."""
    problem = use.problem
    limits, largest = list(problem.limits_by_name.values()), problem.current_max_A
    out = []
    for one in plants:
        stepped = as_steppable(use.plant_of(one))
        episode = charge(
            stepped,
            constant_current(largest),
            limits,
            steps=problem.episode.steps,
            soc_target=problem.episode.soc_target,
            current_max_A=largest,
        )
        out.append(minutes(use.score(episode.noise_free())))
    return float(np.mean(out))


def minutes(score):
    """Minutes to 80 %; infinite where the charge did not get there."""
    value = None if score is None else score.metrics["t80_min"]
    return np.inf if value is None else value


def judged(use, theta, plants, best_min, label, options, **more):
    """One row: this theta on these fresh plants."""
    episodes = use.run([np.array(theta)] * len(plants), plants)
    scores = [use.score(e.noise_free()) if e.ending.value == "done" else None for e in episodes]
    over = sum(score is None or not score.feasible for score in scores)
    worst = {name: max(s.excess[name] for s in scores if s is not None) for name in use.problem.limits_by_name}
    # The oracle's mean is over as many of them.
    mean = float(np.mean([minutes(score) for score in scores[: options.oracles]]))
    return {
        "Ts_s": use.problem.controller.sampling_time_s,
        "method": label + "".join(f", without {part}" for part in options.without),
        "draws": len(plants),
        "violations": over,
        "worst_mV": 1e3 * worst["voltage_max_V"],
        **({"worst_K": worst["temperature_max_K"]} if "temperature_max_K" in worst else {}),
        **({"worst_anode_mV": 1e3 * worst["anode_min_V"]} if "anode_min_V" in worst else {}),
        "bound": violation_bound(over, len(plants), 0.95),
        "mean_t80_min": mean,
        "oracle_mean_t80_min": best_min,
        "ratio": mean / best_min,
        "theta": [round(float(v), 5) for v in theta],
        **more,
    }


def fresh(use, seed, count):
    """Plants that no tuner has drawn."""
    own = np.random.SeedSequence(seed, spawn_key=(0, 7)).generate_state(1, np.uint64)
    return use.draw(count, int(own[0]) >> 11)


def tuner_of(problem, options, seed, spread=0.0, probability=0.99):
    """The tuner that learns this problem's cell, whose circuit is unsure by ``spread`` beside the range."""
    tuned = replace(problem, range=replace(problem.range, **NOTHING)) if "range" in options.without else problem
    start = tuple(options.start) if options.start else None
    return RangeTwinTuner(ChargingRangeTwin(tuned, spread), seed, Safety(options.probability or probability, start), settings_of(options))


# A range of one cell, in one condition: what is not given does not differ. Something has to; a thousandth is nothing.
NOTHING = dict.fromkeys(("resistance_by_node", "capacitance_by_node", "capacity", "fade", "growth"), 0.0) | {
    "soc_start": None, "resistance": 1e-3}  # fmt: skip


def rows_r1(options):
    """Without any trial, over the whole range."""
    problem = r1(options)
    use = ChargingRange(problem)
    for seed in options.seeds:
        plants = fresh(use, seed, options.draws)
        best = oracle(use, plants[: options.oracles])
        begin = time.perf_counter()
        tuned = r1(options, options.tune_step_s)
        # None of 300 fresh draws over a limit is asked: far fewer than one of 300 may be.
        theta = tuner_of(tuned, options, seed, probability=0.999).proposed(problem.space, []).theta
        spent = time.perf_counter() - begin
        more = {"range": "R1", "plant": "R-RC", "seed": seed, "tune_s": spent, "trials": 0}
        label = f"range, no trial{f', tuned at {options.tune_step_s:g} s' if options.tune_step_s else ''}"
        yield judged(use, theta, plants, best, label, options, **more)


def learnt(use, run, tuner, options, best, plants, label, **more):
    """A row for no charge, and one for each number of charges, on one cell; on the way each charge's own true excess."""
    trials, way, spent = [], [], 0.0
    for number in range(options.charges + 1):
        begin = time.perf_counter()
        found = tuner.proposed(use.problem.space, trials)
        spent += time.perf_counter() - begin
        # Rows of a plant that takes long are judged after the last charge alone.
        if number == options.charges or not label:
            yield judged(
                use, found.theta, plants, best, f"{label}{number} charges", options,
                **more, choice=found.choice.name, probability=found.probability, tune_s=spent, trials=number, worst_on_the_way=list(way),
            )  # fmt: skip
        if number == options.charges:
            return
        seed = 1_000_003 * (number + 1) + tuner.seed
        score, episode, _ = run(np.array(found.theta), seed)
        true = use.score(episode.noise_free())
        way.append(None if true is None else {name: round(value, 6) for name, value in true.excess.items()})
        told = {"theta": found.theta, "status": "failed" if score is None else "done", "score": score, "seed": seed}
        trials.append(SimpleNamespace(number=number, **told, episode=lambda episode=episode: episode))


def rows_learn(options):
    """Each cell of R1 for itself."""
    problem = r1(options)
    for cell in options.cells:
        own = replace(problem, range=replace(problem.range, cell=cell))
        use = ChargingRange(own)
        plants = fresh(use, cell, options.draws)
        best = oracle(use, plants[: options.oracles])
        tuner = tuner_of(own, options, options.seeds[0])
        yield from learnt(use, RangeCharge(own), tuner, options, best, plants, "", range="R1", plant="R-RC", cell=cell)


def rows_dfn(options):
    """The electrochemical plant: the declared start over the whole range, then each cell, a draw of resistance, capacity and age."""
    problem = load_config(EXAMPLES / "range_dfn.toml").problem(EXAMPLES)
    use = ChargingRange(replace(problem, range=replace(problem.range, cell=None)))
    for seed in options.seeds:
        plants = fresh(use, seed, options.draws)
        best = oracle(use, plants[: options.oracles])
        label, theta = "DFN, the declared start", problem.safe_start
        yield judged(use, theta, plants, best, label, options, range="DFN", plant="DFN", seed=seed, tune_s=0.0, trials=0)
    for cell in options.cells if options.charges else ():
        own = replace(problem, range=replace(problem.range, cell=cell))
        use = ChargingRange(own)
        plants = fresh(use, cell, options.draws)
        best = oracle(use, plants[: options.oracles])
        tuner = tuner_of(own, options, options.seeds[0], TwinTable().resistance_spread)
        yield from learnt(use, RangeCharge(own), tuner, options, best, plants, "DFN, ", range="DFN", plant="DFN", cell=cell)


class _Structural:
    """Charges of one structural plant from starts that are drawn, with the methods of `ChargingRange` that a row needs."""

    def __init__(self, problem):
        self.problem, self._exact = problem, judged_exactly(problem)
        self._loop = compiled_episode(controller_of(problem), self._at(problem.episode.soc_start), problem.episode.steps)

    def _at(self, soc):
        return self.problem.plant.plant(soc, self.problem.controller.sampling_time_s, self.problem.sensors.sensors())

    def draw(self, count, seed):
        stream = np.random.default_rng([seed, 3])
        starts, seeds = stream.uniform(*self.problem.range.soc_start, count), stream.integers(2**53, size=count)
        return [DrawnPlant(self._at(float(soc)), int(one)) for soc, one in zip(starts, seeds, strict=True)]

    def plant_of(self, drawn):
        return drawn.plant

    def run(self, thetas, plants):
        return self._loop.run_each(list(thetas), [one.plant for one in plants], [one.seed for one in plants])

    def score(self, episode):
        return score_episode(self._exact, episode, soc_start=float(episode.signal("soc")[0][0]))

    def charge(self, theta, seed):
        (episode,) = self.run([theta], self.draw(1, seed))
        return outcome(self.problem, episode, soc_start=float(episode.signal("soc")[0][0]))


def rows_structural(options):
    """A plant that is none of the range: its own discrepancy is what there is to learn."""
    from learning_plants import StructuralPlant

    problem = r1(options)
    for seed in options.seeds:
        own = replace(
            problem,
            plant=StructuralPlant(problem.cell),
            controller=replace(problem.controller, mismatch_seed=seed),
            range=replace(problem.range, soc_start=(0.05, 0.4)),
        )
        use = _Structural(own)
        plants = fresh(use, seed, options.draws)
        best = oracle(use, plants[: options.oracles])
        tuner = tuner_of(own, options, seed)
        yield from learnt(use, use.charge, tuner, options, best, plants, "", range="R1, start 0.05 to 0.4", plant="structural", seed=seed)


def rows_crane(options):
    """One theta for all cranes, beside the theta that is tuned for each crane alone."""
    import sys

    sys.path.insert(0, str(EXAMPLES))
    import range_crane as crane

    import chargetune as ct

    for seed in options.seeds:
        begin = time.perf_counter()
        evaluation, trials = ct.RangeEvaluation(crane.LOOP, 300), []
        tuner = ct.RangeTuner(evaluation, seed)
        for number in range(options.rounds):
            theta = tuner.ask(crane.SPACE, trials)[0]
            score, _, _ = evaluation(theta, 50_000 * (seed + 1) + number)
            trials.append(SimpleNamespace(number=number, theta=tuple(theta), status="done", score=score, seed=50_000 * (seed + 1) + number))
        best = max(trials, key=lambda one: (one.score.feasible, one.score.objective))
        spent = time.perf_counter() - begin
        judges = ct.RangeEvaluation(crane.LOOP, options.draws).results(np.array(best.theta), 77_000_001 + seed)
        alone = []
        for one in judges[: options.oracles]:
            only = _Alone(crane.LOOP, one.plant)
            theta = ct.RangeTuner(ct.RangeEvaluation(only, 1), seed, ct.RangeSettings(plants=1, corners=0, aim=1.0)).ask(crane.SPACE, [])[0]
            alone.append(only.score(only.simulate([theta], [one.plant])[0]).objective)
        own = [one.score.objective for one in judges[: options.oracles]]
        over = sum(not one.score.feasible for one in judges)
        yield {
            "range": "crane", "plant": "crane", "Ts_s": crane.CONTROLLER.model.sampling_time_s, "method": "range, no trial", "seed": seed,
            "draws": len(judges), "violations": over, "worst_excess": max(one.score.worst for one in judges),
            "bound": violation_bound(over, len(judges), 0.95), "mean_objective": float(np.mean(own)),
            "oracle_mean_objective": float(np.mean(alone)), "ratio": float(np.mean(own) / np.mean(alone)), "tune_s": spent, "trials": 0,
        }  # fmt: skip


class _Alone:
    """A range of one plant in one episode."""

    def __init__(self, loop, plant):
        self._loop, self._plant, self.largest_of = loop, plant, loop.largest_of
        self.simulate, self.score, self.samples = loop.simulate, loop.score, loop.samples

    def draw(self, count, _):
        return [self._plant] * count


def main():
    """Print a row as it is done, or all as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=["R1", "learn", "crane"])
    parser.add_argument("--without", nargs="*", choices=WITHOUT, default=[])
    parser.add_argument("--step-s", type=float, default=10.0, help="sampling time of R1, s")
    parser.add_argument(
        "--tune-step-s", type=float, help="sampling time that theta of R1 is tuned at, if another: that is 10 times as fast"
    )
    parser.add_argument("--cells", type=int, nargs="+", default=list(range(4)), help="cells of the rows learn and DFN")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="seeds of the tuner")
    parser.add_argument("--draws", type=int, default=300, help="fresh charges that judge a row")
    parser.add_argument("--oracles", type=int, default=40, help="of them those that the oracle charges too")
    parser.add_argument("--charges", type=int, default=3)
    parser.add_argument("--probability", type=float, help="share of the range that keeps its limits; by default 0.999 for R1, else 0.99")
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--judges", type=int, default=300)
    parser.add_argument("--plants", type=int, default=48)
    parser.add_argument("--iterations", type=int, default=12)
    parser.add_argument("--start", type=float, nargs="+", help="theta of the row R1, to leave that search out of others")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    tables = {"R1": rows_r1, "learn": rows_learn, "crane": rows_crane, "DFN": rows_dfn, "structural": rows_structural}
    rows = []
    for name in options.rows:
        for row in tables[name](options):
            rows.append(row)
            if not options.json:
                print(json.dumps(row), flush=True)
    if options.json:
        print(json.dumps({"rows": rows}))


if __name__ == "__main__":
    main()
