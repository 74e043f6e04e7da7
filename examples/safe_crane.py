"""Tune the crane of custom_system.py without letting its load swing too far in any trial.

The tuner has a twin: the crane's own equations with a rope of which only a guess is known. It learns the rope, and what the
equations leave out, from the traces of the trials, and proposes a theta only where the limit is kept on 95 % of the cranes that
these allow; the first trial is the most cautious one. Run: python examples/safe_crane.py [TRIALS] [SEED]
"""

import sys

import matplotlib.pyplot as plt
from custom_system import CONTROLLER, LIMITS, SPACE, STEPS, closeness, crane

import chargetune as ct

# Standard deviation of one sample; the verdict on a trial is as noisy as its sensors.
NOISE = {"position": 1e-3, "speed": 1e-3, "angle": 1e-4, "turn": 1e-3}
PLANT = ct.SimulatedPlant(crane(1.0), {}, ct.Sensors(noise_sd=NOISE))

# A rope of 0.8 m is a guess: with 95 % probability it is wrong by less than a factor of exp(2 * 0.3), 0.44 m to 1.46 m.
TWIN = ct.SimulatedTwin.build(
    CONTROLLER, crane(0.8), [ct.Uncertain("rope_m", sd=0.3)], noise_sd=NOISE, steps=STEPS, limits=LIMITS, objective=closeness
)


def evaluate(theta, seed):
    """One move of the real crane, and its score."""
    episode = ct.simulate(CONTROLLER, PLANT, steps=STEPS, theta=theta, seed=seed)
    return ct.score_limits(episode, LIMITS, objective=closeness)


def tune(trials, seed, path, settings=None):
    """The trials of a study in this file, each with its noise-free swing beyond the limit, rad, and its objective, m s."""
    tuner = ct.TwinTuner(TWIN, seed=seed, safety=ct.Safety(0.95), settings=settings or ct.TwinSettings())
    study = {"config": {"system": "crane, safe"}, "space": SPACE, "tuner": tuner, "seed": seed}
    with ct.Store(path) as store, ct.Study.create_or_resume(store, f"crane {seed}", **study) as tuning:
        tuning.run(evaluate, trials)
        thetas = [trial.theta for trial in tuning.trials()]
    exact = ct.SimulatedPlant(crane(1.0), {})
    episodes = [ct.simulate(CONTROLLER, exact, steps=STEPS, theta=theta) for theta in thetas]
    scores = [ct.score_limits(episode, LIMITS, objective=closeness).score for episode in episodes]
    return [(theta, episode, score) for theta, episode, score in zip(thetas, episodes, scores, strict=True) if score]


def main(trials, seed):
    """Tune in safe_crane.sqlite, and draw every move in safe_crane.pdf."""
    for number, (theta, episode, score) in enumerate(tune(trials, seed, "safe_crane.sqlite")):
        values = ", ".join(f"{name} = {value:.3g}" for name, value in zip(SPACE.entries, theta, strict=True))
        print(f"trial {number}: objective {score.objective:.3f} m s, swing {1e3 * score.excess['angle']:+.1f} mrad off its limit, {values}")
        plt.plot(episode.time_s, episode.signal("angle")[1], label=f"trial {number}")
    plt.axhspan(LIMITS[0].lower, LIMITS[0].upper, alpha=0.1)
    plt.gca().set(xlabel="time (s)", ylabel="swing (rad)")
    plt.legend()
    plt.savefig("safe_crane.pdf")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5, int(sys.argv[2]) if len(sys.argv) > 2 else 0)
