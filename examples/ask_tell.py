"""The user owns the loop: ask for theta, charge by whatever means, tell what it was worth.

Here the charge is simulated; on a test bench `charge` would run the cycler. Run: python examples/ask_tell.py [TRIALS]
"""

import sys

import chargetune as ct


def main(trials, path):
    """A study in a file: stop it at any time, run it again, and it goes on."""
    config = ct.case_study("backoff", mismatch_seed=1)
    problem = config.problem()
    tuner = ct.ConstrainedLogEI(seed=0)
    with (
        ct.Store(path) as store,
        ct.Study.create_or_resume(store, "my cell", config=config.document(), space=problem.space, tuner=tuner) as study,
    ):
        while True:
            # A charge that was cut off last time comes first, then the tuner's next proposal.
            waiting = study.running() or study.ask_batch(trials)
            if not waiting:
                break
            for trial in waiting:
                # A charge that did not come to its end has no score: over fewer intervals it would look better.
                score, episode, ending = ct.evaluate(problem, trial.theta, trial.seed)
                if score is None:
                    study.fail(trial.number, ending)
                    continue
                study.tell(trial.number, score, episode)
                m = score.metrics
                print(f"trial {trial.number}: overshoot {m['overshoot_mV']:6.1f} mV, t80 {m['t80_min'] or float('nan'):.1f} min")
        result = study.result()
    best = result.kept
    print("no trial kept the limits" if best is None else f"result: trial {best.number}, theta = {[round(v, 4) for v in best.theta]}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 15, sys.argv[2] if len(sys.argv) > 2 else "ask_tell.sqlite")
