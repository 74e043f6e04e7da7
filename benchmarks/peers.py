"""The same closed loop (problem P0) by do-mpc and by CasADi's IPOPT, as their users would write it, warm-started and quiet.

Both get chargetune's own model functions (explicit piecewise cubics), constrain the voltage at both ends of an interval
softly, from below and above, and step the same plant.
"""

import time
import warnings

import casadi as ca
import numpy as np

from chargetune.battery.cell.equivalent_circuit import ecm_model
from chargetune.battery.charging.controller import controller_of

LOWEST_V, LIMIT_V, CURRENT_MAX_A, PENALTY = 2.5, 4.2, 6.0, 1e3


def do_mpc_loop(problem, steps):
    """(currents (A), seconds) of a loop by do-mpc; set-up not counted."""
    with warnings.catch_warnings():
        # It announces the optional packages it could not import.
        warnings.simplefilter("ignore")
        import do_mpc

    own, plant = controller_of(problem).model, ecm_model(problem.cell)
    model = do_mpc.model.Model("discrete", "SX")
    z, u1 = model.set_variable("_x", "z"), model.set_variable("_x", "u1")
    current = model.set_variable("_u", "i")
    state = ca.vertcat(z, u1)
    after = own.f(state, current, own.nominal)
    model.set_rhs("z", after[0])
    model.set_rhs("u1", after[1])
    model.set_expression("start", own.h(state, current, own.nominal)[0])
    model.set_expression("end", own.h(after, current, own.nominal)[0])
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    quiet = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes"}
    mpc.set_param(
        n_horizon=problem.controller.horizon, t_step=problem.controller.sampling_time_s, store_full_solution=False, nlpsol_opts=quiet
    )
    mpc.set_objective(lterm=(1 - model.x["z"]) ** 2, mterm=(1 - model.x["z"]) ** 2)
    mpc.set_rterm(i=0.0)
    mpc.bounds["lower", "_u", "i"] = 0.0
    mpc.bounds["upper", "_u", "i"] = CURRENT_MAX_A
    for name in ("start", "end"):
        mpc.set_nl_cons(f"{name}_max", model.aux[name], ub=LIMIT_V, soft_constraint=True, penalty_term_cons=PENALTY)
        mpc.set_nl_cons(f"{name}_min", -model.aux[name], ub=-LOWEST_V, soft_constraint=True, penalty_term_cons=PENALTY)
    mpc.setup()
    x = np.array([[problem.episode.soc_start], [0.0]])
    mpc.x0 = x
    mpc.set_initial_guess()
    return _loop(lambda at: mpc.make_step(at)[0, 0], plant, x, steps)


def ipopt_loop(problem, steps):
    """(currents (A), seconds) of a loop by single shooting on CasADi's nlpsol with IPOPT; set-up not counted."""
    own, plant, horizon = controller_of(problem).model, ecm_model(problem.cell), problem.controller.horizon
    start, inputs, slack = ca.SX.sym("x", 2), ca.SX.sym("u", horizon), ca.SX.sym("s")
    state, cost, rows = start, PENALTY * slack, []
    for i in range(horizon):
        cost += (1 - state[0]) ** 2
        after = own.f(state, inputs[i], own.nominal)
        for end in (state, after):
            voltage = own.h(end, inputs[i], own.nominal)[0]
            rows += [voltage - LIMIT_V - slack, LOWEST_V - voltage - slack]
        state = after
    cost += (1 - state[0]) ** 2
    nlp = {"x": ca.vertcat(inputs, slack), "p": start, "f": cost, "g": ca.vertcat(*rows)}
    options = {"ipopt": {"print_level": 0, "sb": "yes", "warm_start_init_point": "yes"}, "print_time": False}
    solve = ca.nlpsol("solve", "ipopt", nlp, options)
    guess = {"x0": np.zeros(horizon + 1), "lam_x0": 0.0, "lam_g0": 0.0}

    def act(x):
        found = solve(p=x, lbx=0.0, ubx=[CURRENT_MAX_A] * horizon + [np.inf], lbg=-np.inf, ubg=0.0, **guess)
        plan = np.array(found["x"]).ravel()
        guess.update(x0=np.concatenate([plan[1:horizon], plan[horizon - 1 :]]), lam_x0=found["lam_x"], lam_g0=found["lam_g"])
        return plan[0]

    return _loop(act, plant, np.array([problem.episode.soc_start, 0.0]), steps)


def _loop(act, plant, x, steps):
    p, currents = plant.nominal, []
    begin = time.perf_counter()
    for _ in range(steps):
        u = act(x)
        currents.append(float(u))
        x = np.array(plant.f(x, u, p)).reshape(x.shape)
    return np.array(currents), time.perf_counter() - begin
