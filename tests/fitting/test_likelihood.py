"""The likelihood against its definition: residuals, derivatives, covariances, variances."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import multivariate_t

from slipid.fitting import likelihood as lk
from slipid.fitting import noise as of_noise
from slipid.fitting import variances
from slipid.fitting.newton import newton_step
from slipid.fitting.problem import FitState, Problem, linear
from slipid.fitting.variances import DEGREES, fitted_covariance, inverse_root, scoring_step
from slipid.infer.slip_curves import current_trend
from slipid.search_space import Choice
from tests.helpers.dense import of_shared
from tests.helpers.made_windows import electric_noise, made, residuals, robot

EVERYTHING = [Choice("*", free=True)]
NOTHING = Choice("*", free=False)
NOISE = {
    "camera.place": 0.0005,
    "camera.heading": 0.003,
    "process.along": 0.004,
    "process.across": 0.003,
    "process.yaw": 0.01,
    "run.along": 0.01,
    "run.across": 0.006,
    "run.yaw": 0.03,
    "current.window": 0.05,
    "voltage.window": 0.05,
}


@pytest.fixture(scope="module")
def truth():
    return robot()


@pytest.fixture(scope="module", params=[True, False], ids=["signed", "unsigned"])
def everything(request, truth):
    """A problem in which every declared number is free."""
    return Problem(made(truth, std=NOISE, signed=request.param), truth, EVERYTHING)


# residuals


@pytest.mark.parametrize("signed", [True, False])
@pytest.mark.slow
def test_without_noise_the_truth_leaves_no_residual(truth, signed):
    b = lk.batch(made(truth, signed=signed), truth)
    blocks = jax.jit(residuals)(truth, b, electric_noise(b, 1.0))
    assert sorted(blocks) == ["current", "motion", "voltage"]
    for name, r in blocks.items():
        assert r.shape == (24, 6)
        np.testing.assert_allclose(r, 0.0, atol=1e-9, err_msg=name)


@pytest.mark.slow
def test_channels_that_were_not_logged_have_no_block(truth):
    w = made(truth, voltage=False)
    b = lk.batch(w, truth)
    assert sorted(residuals(truth, b, electric_noise(b, 1.0))) == ["current", "motion"]
    w = replace(w, has_current=False)
    b = lk.batch(w, truth)
    assert sorted(residuals(truth, b, electric_noise(b, 1.0))) == ["motion"]
    assert list(of_noise.noise(w, truth).blocks) == ["motion"]


@pytest.mark.slow
def test_the_frame_of_the_world_does_not_matter(truth):
    w = made(truth, std=NOISE)
    c, s = np.cos(0.7), np.sin(0.7)
    turned = w.pose.copy()
    turned[..., :2] = w.pose[..., :2] @ np.array([[c, s], [-s, c]]) + [3.0, -2.0]
    turned[..., 2] += 0.7
    one, two = (lk.measured_increments(truth, jnp.asarray(pose)) for pose in (w.pose, turned))
    np.testing.assert_allclose(one, two, atol=1e-12)


@pytest.mark.slow
def test_jacobians_are_those_of_finite_differences(everything):
    z, volt = jnp.asarray(everything.space.start), electric_noise(everything.batch, 0.05)
    _, jacobian = everything.linear(z, volt)
    for k, name in enumerate(everything.space.names):
        h = 1e-5
        e = jnp.zeros(len(z)).at[k].set(h)
        more, less = everything.linear(z + e, volt)[0], everything.linear(z - e, volt)[0]
        for block in jacobian:
            numeric = np.asarray((more[block] - less[block]) / (2 * h))
            tolerance = 1e-6 * max(1.0, np.abs(numeric).max())
            np.testing.assert_allclose(
                jacobian[block][..., k], numeric, atol=tolerance, err_msg=f"{block} by {name}"
            )


@pytest.mark.slow
@pytest.mark.parametrize("moved", [1e-3, np.nan, 1e6])
def test_residuals_do_not_depend_on_the_twists_that_the_root_finder_starts_from(everything, moved):
    """From good twists, from none, and from such as lead plain Newton steps astray."""
    volt = electric_noise(everything.batch, 0.05)
    first = linear(everything.objective, everything.space.start, volt)
    near = first.twists._replace(steady=np.asarray(first.twists.steady) + moved)
    again = linear(everything.objective, everything.space.start, volt, near)
    for block, residual in first.residual.items():
        assert np.isfinite(residual).all()
        np.testing.assert_allclose(again.residual[block], residual, atol=1e-9)
        np.testing.assert_allclose(again.jacobian[block], first.jacobian[block], atol=1e-7)


@pytest.mark.slow
def test_every_number_but_the_known_silent_ones_moves_the_residuals(everything):
    _, jacobian = everything.linear(everything.space.start, electric_noise(everything.batch, 0.05))
    size = sum(np.abs(np.asarray(j)).sum(axis=(0, 1)) for j in jacobian.values())
    silent = {n for n, s in zip(everything.space.names, size, strict=True) if s < 1e-9}
    # inertia and inductance act in transients, which windows average out
    transient = {"motor.inductance", "motor.rotor_inertia", "robot.yaw_inertia"}
    # and omni wheels have one radius on every floor
    radii = {f"surface.{name}.rolling_radius" for name in ("firm", "soft")}
    # and a drop of the brushes of 0 V has no curve
    curve = {f"motor.brush_{name}" for name in ("current", "shape", "tail")}
    assert silent == transient | radii | curve


@pytest.mark.slow
@pytest.mark.parametrize("signed", [True, False])
def test_voltages_are_predicted_from_what_is_expected_of_the_true_current(truth, signed):
    """A normal around the predicted current, seen with the ammeter's noise."""
    w = made(truth, std=NOISE, signed=signed)
    truth = eqx.tree_at(lambda r: r.motor.current_offset, truth, jnp.asarray(0.02))
    b, motor_force = lk.batch(w, truth), lk.predict(truth, lk.batch(w, truth)).motor_force
    sigma, s, volt = 0.2, 0.05, 0.1
    b = replace(b, current_var=jnp.full_like(b.current, sigma**2))
    found = lk.electric_residuals(truth, b, motor_force, electric_noise(b, volt, s))["voltage"]
    speed, m = w.turn / w.dt[..., None], np.asarray(lk.predicted_current(truth, b, motor_force))
    amps = (m / s**2 + w.current / sigma**2) / (1 / s**2 + 1 / sigma**2) - 0.02
    way = 1.0 if signed else np.tanh(speed / 0.2)
    left = 1 / (1 / s**2 + 1 / sigma**2) * (5.5 * way) ** 2
    gap = np.asarray(truth.motor.voltage(jnp.asarray(amps * way), jnp.asarray(speed))) - w.voltage
    expected = gap / np.sqrt(1 + left / volt**2)
    np.testing.assert_allclose(found, expected.reshape(24, 6), rtol=1e-9)


def only_piece(b, k):
    return jax.tree.map(lambda x: x[k : k + 1] if x.ndim else x, b)


@pytest.mark.slow
def test_log_jacobian_is_the_determinant_of_residuals_by_data(truth):
    """Of the 3 numbers per window that a segment measures, its first pose given."""
    bent = eqx.tree_at(
        lambda r: (r.camera.tilt, r.camera.radial, r.camera.tangential),
        truth,
        (jnp.array([0.05, -0.08]), jnp.array(0.06), jnp.array([0.03, -0.02])),
    )
    w = made(truth, runs=6, std=NOISE)
    b = lk.batch(w, bent)
    b = replace(b, current_var=jnp.full_like(b.current, 0.02))
    found = sum(lk.log_jacobians(bent, b, electric_noise(b, 0.05)))
    for k in range(len(w)):
        pose, one = jnp.asarray(w.pose[k]), only_piece(b, k)

        def of_poses(later, first=pose[:1]):
            return lk.measured_increments(bent, jnp.concatenate([first, later])[None]).ravel()

        def of_volts(volt, one=one):
            still = jnp.zeros((*one.current.shape, 2))
            b = replace(one, voltage=volt[None])
            noise = electric_noise(b, 0.05)
            return lk.electric_residuals(bent, b, still, noise)["voltage"].ravel()

        expected = 0.0
        for residual, data in ((of_poses, pose[1:]), (of_volts, b.voltage[k])):
            square = np.asarray(jax.jacfwd(residual)(data)).reshape(6, 6)
            expected += np.linalg.slogdet(square)[1]
        np.testing.assert_allclose(found[k], expected, rtol=1e-10)


# covariances


@pytest.mark.parametrize(("which", "block"), [(0, "place"), (1, "heading")])
@pytest.mark.slow
def test_camera_noise_enters_as_the_poses_do(truth, which, block):
    """B = G G^T with G the derivative of the measured increments by the noisy poses."""
    w = made(truth, std=NOISE)
    base = of_noise.noise(w, truth).blocks["motion"].base[:, which]
    for k in range(0, len(w), 5):
        g = jax.jacfwd(lambda pose: lk.measured_increments(truth, pose[None])[0])(
            jnp.asarray(w.pose[k])
        )
        g = np.asarray(g).reshape(6, 3, 3)
        g = g[..., :2].reshape(6, 6) if block == "place" else g[..., 2]
        # process noise bends the path a little, so that turns differ from those of the poses
        np.testing.assert_allclose(base[k], g @ g.T, atol=1e-10)


@pytest.mark.slow
def test_a_camera_error_is_shared_by_neighbouring_windows(truth):
    base = of_noise.noise(made(truth, count=4), truth).blocks["motion"].base[:, 0]
    along = base[:, 0::3, 0::3] + base[:, 1::3, 1::3]
    assert (np.diagonal(along, offset=1, axis1=1, axis2=2) < 0).all()
    np.testing.assert_allclose(np.diagonal(along, offset=2, axis1=1, axis2=2), 0.0, atol=1e-12)


def test_process_noise_grows_with_distance_and_run_effects_with_its_square(truth):
    w = made(truth)
    twice = replace(w, turn=2 * w.turn)
    one, two = (of_noise.noise(x, truth).blocks["motion"].base for x in (w, twice))
    np.testing.assert_allclose(two[:, 2:5], 2 * one[:, 2:5], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(two[:, 5:8], 4 * one[:, 5:8], rtol=1e-9, atol=1e-15)
    far, _ = of_noise.travel(w, truth)
    np.testing.assert_allclose(np.trace(one[:, 2], axis1=1, axis2=2), far.sum(axis=1), rtol=1e-9)


def test_a_run_effect_is_one_number_for_the_whole_run(truth):
    base = of_noise.noise(made(truth), truth).blocks["motion"].base[:, 5:8]
    assert (np.linalg.matrix_rank(base, tol=1e-9) == 1).all()


def test_variances_belong_to_the_floor_of_the_run(truth):
    w = made(truth)
    noise = of_noise.noise(w, truth)
    for k, floor in enumerate(w.surface):
        names = [noise.names[i] for i in noise.blocks["motion"].which[k]]
        assert names[:2] == ["camera.place", "camera.heading"]
        assert {n.split(".")[1] for n in names[2:]} == {floor}
        assert [n.split(".")[2] for n in names[2:]] == ["along", "across", "yaw"] * 2
        names = [noise.names[i] for i in noise.blocks["current"].which[k]]
        assert names == [f"current.{floor}.window", f"current.{floor}.run"]


@pytest.mark.slow
def test_covariances_are_positive_definite_whatever_the_variances(everything):
    rng = np.random.default_rng(0)
    for _ in range(10):
        log_v = 2 * np.log(everything.noise.typical) + rng.normal(0, 3, len(everything.noise.names))
        for block in everything.noise.blocks:
            v = np.asarray(everything.covariance(block, log_v))
            np.testing.assert_allclose(v, v.transpose(0, 2, 1), rtol=1e-12, atol=1e-18)
            assert (np.linalg.eigvalsh(v) > 0).all()


@pytest.mark.parametrize("size", [1, 2, 5, 12])
@pytest.mark.slow
def test_inverse_root_is_numpy_s(size):
    rng = np.random.default_rng(size)
    a = rng.normal(size=(50, size, size)) * np.exp(rng.normal(0, 2, (50, size, 1)))
    v = a @ a.transpose(0, 2, 1) + 1e-6 * np.eye(size)
    root = np.asarray(inverse_root(jnp.asarray(v)))
    expected = np.linalg.inv(np.linalg.cholesky(v))
    np.testing.assert_allclose(root, expected, atol=1e-7 * np.abs(expected).max())
    np.testing.assert_allclose(root @ v @ root.transpose(0, 2, 1), [np.eye(size)] * 50, atol=1e-6)


# weights and information


@pytest.mark.slow
def test_the_loss_is_a_student_t_per_run(everything):
    """Up to a constant, against scipy's multivariate t."""
    z = everything.space.start
    blocks = everything.linear(z, electric_noise(everything.batch, 0.05))[0]
    typical = 2 * np.log(everything.noise.typical)
    keep = np.ones(24)
    keep[3:7] = 0.0

    def theirs(log_v):
        total = 0.0
        for k, r in blocks.items():
            v = np.asarray(everything.covariance(k, log_v))
            for segment in np.flatnonzero(keep):
                total -= multivariate_t.logpdf(np.asarray(r[segment]), shape=v[segment], df=DEGREES)
        return total

    def ours(log_v):
        return float(everything.whitening(blocks, log_v, keep)[2])

    other = typical + np.linspace(-1, 1, len(typical))
    assert ours(typical) - ours(other) == pytest.approx(theirs(typical) - theirs(other), rel=1e-9)


@pytest.mark.slow
def test_whitened_residuals_are_weighted_mahalanobis_distances(everything):
    blocks = everything.linear(everything.space.start, electric_noise(everything.batch, 0.05))[0]
    log_v = 2 * np.log(everything.noise.typical)
    root, weight, _ = everything.whitening(blocks, log_v, np.ones(24))
    for k, r in blocks.items():
        v = np.asarray(everything.covariance(k, log_v))
        q = np.einsum("ni,nij,nj->n", r, np.linalg.inv(v), r)
        np.testing.assert_allclose(weight[k], (DEGREES + 6) / (DEGREES + q), rtol=1e-6)
        white = np.einsum("nij,nj->ni", root[k], r)
        np.testing.assert_allclose((white**2).sum(axis=1), np.asarray(weight[k]) * q, rtol=1e-6)


def information(problem, jacobian, log_v, blocks):
    """Expected information in numpy, prior included, what runs share by their whole covariance."""
    total = np.diag(1 / np.asarray(problem.objective.prior_std(log_v)) ** 2)
    for k in blocks:
        j = np.asarray(jacobian[k])
        factor = (DEGREES + j.shape[1]) / (DEGREES + j.shape[1] + 2)
        covariance = block_diag(*np.asarray(problem.covariance(k, log_v)) / factor)
        if k == "motion":
            covariance = covariance + of_shared(problem, log_v)
        flat = j.reshape(-1, j.shape[-1])
        total = total + flat.T @ np.linalg.solve(covariance, flat)
    return total


@pytest.mark.slow
def test_the_information_without_currents_is_that_of_the_motion_and_the_prior(truth):
    w = replace(made(truth, std=NOISE), has_current=False, has_voltage=False)
    problem = Problem(w, truth, EVERYTHING)
    log_v = 2 * np.log(problem.noise.typical)
    _, jacobian = problem.linear(problem.space.start, problem.electric(problem.space.start, log_v))
    ours = problem.precision(jacobian, log_v, np.ones(24))
    theirs = information(problem, jacobian, log_v, jacobian)
    np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-8 * np.abs(theirs).max())


@pytest.mark.slow
def test_a_cut_keeps_what_motion_alone_says_of_the_motion():
    truth = robot()
    choices = [Choice("camera.*", free=True), Choice("motor.inductance", free=False)]
    problem = Problem(made(truth, std=NOISE), truth, choices)
    log_v = 2 * np.log(problem.noise.typical)
    _, jacobian = problem.linear(problem.space.start, problem.electric(problem.space.start, log_v))
    cut = np.linalg.inv(np.asarray(problem.precision(jacobian, log_v, np.ones(24))))
    alone = np.linalg.inv(information(problem, jacobian, log_v, ["motion"]))
    m, e = ~problem.space.electric, problem.space.electric
    assert e.any()
    np.testing.assert_allclose(cut[np.ix_(m, m)], alone[np.ix_(m, m)], rtol=1e-6, atol=1e-12)
    # electric numbers: what is left at fixed motion plus what the motion's uncertainty adds
    full = information(problem, jacobian, log_v, jacobian)
    own = np.linalg.inv(full[np.ix_(e, e)])
    slope = -own @ full[np.ix_(e, m)]
    expected = own + slope @ alone[np.ix_(m, m)] @ slope.T
    np.testing.assert_allclose(cut[np.ix_(e, e)], expected, rtol=1e-6, atol=1e-12)


@pytest.mark.slow
def test_no_bit_of_a_step_depends_on_runs_that_are_left_out(truth):
    """A step contains motion, currents, voltages, shared effects and variances.

    Wheels of the replaced runs turn backwards, so that every run keeps its speed.
    """
    w = made(truth, std=NOISE)
    keep = np.ones(24)
    keep[::3] = 0.0
    rng = np.random.default_rng(1)
    change = {"turn": np.negative, "direction": np.negative}
    noise = ("pose", "speed_change", "current", "voltage", "current_var")
    change |= {name: lambda x: np.abs(rng.normal(size=x.shape)) for name in noise}
    odd = {
        name: np.where(keep[:, None, None], x, change[name](x))
        for name, x in vars(w).items()
        if name in change
    }
    one, other = (numbers_of_a_step(Problem(x, truth, []), keep) for x in (w, replace(w, **odd)))
    for name, value in one.items():
        np.testing.assert_array_equal(other[name], value, err_msg=name)


def numbers_of_a_step(problem, keep):
    """All that a round of a fit takes from residuals, with every run's own effect known."""
    log_v, z, segments = 2 * np.log(problem.noise.typical), problem.space.start, len(keep)
    electric = problem.electric(z, log_v)
    blocks, jacobian = both = problem.linear(z, electric)
    at = jnp.asarray(log_v), jnp.asarray(keep)
    weighed = problem.weighed(blocks, log_v, keep, np.zeros((segments, 3)))
    spread = fitted_covariance(problem.objective, jacobian, *at)
    step = newton_step(problem, FitState(z, log_v, 0, np.inf, np.inf, "joint"), both, keep)
    posteriors = variances.expected_posteriors(problem.objective, *at)
    return {
        "information": problem.precision(jacobian, log_v, keep),
        "variances": scoring_step(problem.objective, blocks, spread, *at, None),
        "certainty": variances.information(problem.noise.blocks, *at, None),
        "weights": np.concatenate([x * keep for x in weighed.whitening.weight.values()]),
        "loss": problem.loss(z, log_v, keep, weighed, electric),
        "shared": np.concatenate([p.factor.ravel() for p in posteriors]),
        "step": step.step,
        "step's information": step.information,
    }


# variances by restricted maximum likelihood


@pytest.fixture
def toy(gaussian):
    """A linear Gaussian problem with many structural numbers for its data, and its truth.

    The covariance segments are those of real windows; residuals and Jacobian are random numbers.
    """
    true = robot(floors=("soft",), loads=("as_built",), sessions=("one",))
    w = replace(made(true, runs=80), has_current=False, has_voltage=False)
    held = [Choice(f"surface.*.{name}", free=False) for name in ("load_bias", "drag_exponent")]
    problem = Problem(w, true, [Choice("*", free=True), *held]).without_shared_effects()
    rng = np.random.default_rng(11)
    std = problem.noise.typical.copy()
    std[:8] = [0.0008, 0.004, 0.006, 0.004, 0.012, 0.008, 0.012, 0.03]
    assert problem.noise.names[7] == "run.soft.yaw"
    v = np.asarray(problem.covariance("motion", 2 * np.log(std)))
    columns = problem.space.size
    jacobian = rng.normal(size=(80, 6, columns)) * np.sqrt(np.einsum("nii->ni", v))[..., None]
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(v), rng.normal(size=(80, 6)))
    beta = rng.normal(size=columns) * np.asarray(problem.space.prior_std)
    return problem, jacobian, noise + jacobian @ beta, std


OF_MOTION = np.arange(8)
"""Numbers of the variances of camera, process and runs on the one floor of `toy`."""


def alternate(problem, jacobian, y, rounds=60):
    """Generalised least squares and a scoring step in turn, until both rest."""
    log_v, keep = 2 * np.log(problem.noise.typical), jnp.ones(len(y))
    of_effects = np.isin(np.arange(len(log_v)), OF_MOTION)  # as for a rung
    target = replace(problem.objective, scored=problem.objective.scored | of_effects)
    for _ in range(rounds):
        v = np.linalg.inv(np.asarray(problem.covariance("motion", log_v)))
        info = np.einsum("nip,nij,njq->pq", jacobian, v, jacobian)
        info += np.diag(1 / problem.space.prior_std**2)
        beta = np.linalg.solve(info, np.einsum("nip,nij,nj->p", jacobian, v, y))
        r = {"motion": jnp.asarray(y - jacobian @ beta)}
        spread = np.einsum("nip,pq,njq->nij", jacobian, np.linalg.inv(info), jacobian)
        before = log_v
        told = {"motion": jnp.asarray(spread)}
        log_v = np.asarray(scoring_step(target, r, told, jnp.asarray(log_v), keep, None))
    assert np.abs(log_v - before).max() < 1e-6
    return log_v


@pytest.mark.slow
def test_variances_are_those_of_the_marginal_likelihood(toy):
    """With the structure integrated out in closed form, y ~ N(0, V + J S J^T): its summit."""
    problem, jacobian, y, _ = toy
    flat = jacobian.reshape(-1, jacobian.shape[-1])
    of_structure = (flat * problem.space.prior_std**2) @ flat.T
    typical = 2 * np.log(problem.noise.typical)

    def minus_log_posterior(log_v):
        total = of_structure.copy()
        for k, v in enumerate(np.asarray(problem.covariance("motion", log_v))):
            total[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += v
        root = np.linalg.cholesky(total)
        half = np.linalg.solve(root, y.ravel())
        prior = 0.5 * (((log_v - typical) / 3.0) ** 2).sum()
        return np.log(np.diag(root)).sum() + 0.5 * half @ half + prior

    def slopes(log_v, h=1e-3):
        steps = h * np.eye(len(log_v))
        f = minus_log_posterior
        return np.array([(f(log_v + e) - f(log_v - e)) / (2 * h) for e in steps])

    found = alternate(problem, jacobian, y)
    assert np.abs(slopes(found)).max() < 2e-3
    lowest = minus_log_posterior(found)
    for e in 0.3 * np.eye(len(found)):
        assert min(minus_log_posterior(found + e), minus_log_posterior(found - e)) > lowest


@pytest.mark.slow
def test_variances_are_recovered_although_the_structure_eats_degrees_of_freedom(toy):
    problem, jacobian, y, std = toy
    found = alternate(problem, jacobian, y)
    # expected information of the log variances, I_ij = v_i v_j tr(P B_i P B_j) / 2
    flat = jacobian.reshape(-1, jacobian.shape[-1])
    total = (flat * problem.space.prior_std**2) @ flat.T
    base = np.zeros((len(std), *total.shape))
    segments = problem.noise.blocks["motion"].base
    for k, v in enumerate(np.asarray(problem.covariance("motion", 2 * np.log(std)))):
        at = slice(6 * k, 6 * k + 6)
        total[at, at] += v
        base[OF_MOTION, at, at] = segments[k]
    scaled = [v * np.linalg.solve(total, b) for v, b in zip(std**2, base, strict=True)]
    info = 0.5 * np.array([[np.sum(a * b.T) for a in scaled] for b in scaled])
    info += np.eye(len(std)) / 9
    z = (found - 2 * np.log(std)) / np.sqrt(np.diag(np.linalg.inv(info)))
    assert np.abs(z).max() < 3.0, z


@pytest.mark.slow
@pytest.mark.parametrize("careful", [True, False])
def test_scores_of_variances_have_no_bias_where_degrees_of_freedom_are_given_back(toy, careful):
    """Mean over all data of a step from the truth; it is quadratic in the residuals."""
    problem, jacobian, _, std = toy
    log_v, keep = 2 * np.log(std), jnp.ones(len(jacobian))
    v = np.asarray(problem.covariance("motion", log_v))
    inverse = np.linalg.inv(v)
    told = np.einsum("nip,nij,njq->pq", jacobian, inverse, jacobian)
    left_open = np.linalg.inv(told + np.diag(1 / problem.space.prior_std**2))
    spread = np.einsum("nip,pq,njq->nij", jacobian, left_open, jacobian)
    of_effects = np.isin(np.arange(len(log_v)), OF_MOTION)
    target = replace(problem.objective, scored=problem.objective.scored | of_effects)

    def step(residual):
        around = {"motion": jnp.asarray(spread if careful else 0 * spread)}
        seen = {"motion": jnp.asarray(residual)}
        return (
            np.asarray(scoring_step(target, seen, around, jnp.asarray(log_v), keep, None)) - log_v
        )

    # what is left of data by the best structural numbers: the covariance, summed over its columns
    flat = jacobian.reshape(480, -1)
    of_left = block_diag(*v) - flat @ left_open @ flat.T
    small = 1e-3  # steps are bounded
    still, mean = step(np.zeros((80, 6))), np.zeros(len(std))
    for column in np.linalg.cholesky(of_left + 1e-14 * np.eye(480)).T:
        mean += (step(small * column.reshape(80, 6)) - still) / small**2
    info = np.asarray(variances.information(problem.objective.blocks, log_v, keep, None))
    score = -(log_v - np.asarray(problem.objective.typical)) / 9
    segments = problem.noise.blocks["motion"].base
    spent = np.einsum("nij,njk,nkl->nil", inverse, spread, inverse)
    lost = 0.5 * np.exp(log_v[OF_MOTION]) * np.einsum("nij,ncij->c", spent, segments)
    score[OF_MOTION] -= 0.0 if careful else lost
    expected = np.linalg.solve(info, score)
    np.testing.assert_allclose((still + mean)[OF_MOTION], expected[OF_MOTION], atol=1e-5)
    assert lost.min() > 0.1


def fitted(problem, jacobian, y, std):
    v = np.linalg.inv(np.asarray(problem.covariance("motion", 2 * np.log(std))))
    info = np.einsum("nip,nij,njq->pq", jacobian, v, jacobian)
    info += np.diag(1 / problem.space.prior_std**2)
    return jacobian @ np.linalg.solve(info, np.einsum("nip,nij,nj->p", jacobian, v, y))


# electric noise: voltages tell of the scatter of currents, too


@pytest.mark.slow
@pytest.mark.parametrize("ammeter", [2e-4, 5e-3])
def test_scoring_steps_end_where_the_loss_is_level_in_electric_noise(truth, ammeter):
    w = made(truth, runs=48, std=NOISE)
    noisy = np.random.default_rng(0).uniform(0, ammeter, w.current_var.shape)
    problem = Problem(
        replace(w, current_var=noisy), truth, [NOTHING, Choice("motor.inductance", free=True)]
    )
    z, keep, target = problem.space.start, jnp.ones(len(w)), problem.objective
    log_v = np.asarray(target.typical)
    blocks, _, motor_force, _ = linear(target, z, problem.electric(z, log_v))
    certain = {k: jnp.zeros((*r.shape, r.shape[1])) for k, r in blocks.items()}
    for _ in range(60):
        told = problem.voltage_information(z, log_v, motor_force)
        blocks = blocks | {"voltage": told.residual}
        log_v = np.asarray(scoring_step(target, blocks, certain, jnp.asarray(log_v), keep, told))

    def loss(step):
        electric = problem.electric(z, log_v + step)
        blocks, _ = problem.linear(z, electric)
        seen = problem.weighed(blocks, log_v + step, keep, np.zeros((len(w), 3)))
        return problem.loss(z, log_v + step, keep, seen, electric)

    for k, name in enumerate(problem.noise.names):
        if name.startswith(("current", "voltage")):
            step = 1e-4 * np.eye(len(log_v))[k]
            assert (loss(step) - loss(-step)) / 2e-4 == pytest.approx(0.0, abs=0.01), name


@pytest.mark.slow
@pytest.mark.parametrize("signed", [True, False])
def test_the_trend_of_currents_is_of_their_sizes_over_the_encoders_speed(signed):
    truth = robot()
    b = lk.batch(made(truth, signed=signed), truth)
    predicted = lk.predicted_current(truth, b, lk.predict(truth, b).motor_force)
    speed = (of_noise.travel(b, truth)[0] / b.dt)[..., None]
    more = jnp.sign(predicted) * (0.05 - 0.3 * speed)
    told = eqx.tree_at(lambda x: x.current, b, (predicted + more).at[0, 0, 0].set(jnp.nan))
    np.testing.assert_allclose(current_trend(truth, told), (0.05, -0.3), atol=1e-9)
