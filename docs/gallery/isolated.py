# %% [markdown]
# # The paper's isolated tests
#
# Four parts of the paper, each on its own: the uncertainty of a curve, its expansion, the fit of detections, and the
# simplification.

# %%
import matplotlib.pyplot as plt
import numpy as np
from scipy.linalg import block_diag

from pathspace_graph.baselines.ckf import beyond_end, fit_detections, proximity_chain
from pathspace_graph.baselines.filters import curvature_weighted_breaks
from pathspace_graph.factors.residuals import greville, smoothness_matrix
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track
from pathspace_graph.spline.bspline import (
    SAMPLED_WEIGHT,
    BSpline,
    LeastSquares,
    end_change_matrix,
    fit_spline,
)


def posterior(spline, seen, sigma_bend, sigma_anchor, sigma_detection=0.3):
    """Covariance of control points, seen across the curve at parameters, with weak priors."""
    across = spline.basis_matrix(seen)[:, :, None] * spline.normal_unit(seen)[:, None, :]
    rows = across.reshape(len(seen), -1) / sigma_detection
    second_differences = smoothness_matrix(greville(spline.knots, spline.degree), None)
    bend = np.kron(second_differences, np.eye(2)) / sigma_bend
    return np.linalg.inv(rows.T @ rows + bend.T @ bend + np.eye(2 * spline.size) / sigma_anchor**2)


def draw(axes, spline, color, name, covariance=None):
    """Draw a curve with its control points and, with a covariance, its 2-sigma band."""
    u = np.linspace(*spline.domain, 300)
    points = spline.evaluate(u)
    axes.plot(*points.T, color=color, label=name)
    axes.plot(*spline.control_points.T, ":s", color=color, markersize=3, linewidth=0.6)
    if covariance is not None:
        offset = 2 * spline.normal_sigma(u, covariance)[:, None] * spline.normal_unit(u)
        axes.fill(*np.concatenate([points + offset, (points - offset)[::-1]]).T, color=color, alpha=0.2)
    axes.set_aspect("equal")


# %% [markdown]
# ## Uncertainty
#
# Nothing was seen on a stretch of the curve. The joint covariance of its control points, through the basis functions, gives the spread of
# splines that are drawn from it. The sum of squared basis functions does not, as it leaves the cross terms out.

# %%
x = 5.5 * np.arange(13)
spline = BSpline.open_uniform(np.stack([x, 6 * np.sin(2 * np.pi * x / x[-1])], axis=1), interval=5.5).clamp()
share = (np.arange(18) + 0.5) / 18
seen = spline.parameters_at(spline.length() * share[(share < 0.52) | (share > 0.74)])
covariance = posterior(spline, seen, 1.0, 2.0)

u = np.linspace(*spline.domain, 301)
joint = spline.normal_sigma(u, covariance)
marginals = spline.normal_sigma(u, covariance * np.kron(np.eye(spline.size), np.ones((2, 2))))
drawn = np.random.default_rng(0).multivariate_normal(spline.control_points.ravel(), covariance, 2000)
curves = np.einsum("nm,smd->snd", spline.basis_matrix(u), drawn.reshape(len(drawn), -1, 2))
sampled = np.einsum("snd,nd->sn", curves - spline.evaluate(u), spline.normal_unit(u)).std(axis=0)

figure, (above, below) = plt.subplots(2, 1, figsize=(7, 5), layout="constrained")
for curve in curves[:40]:
    above.plot(*curve.T, color="0.8", linewidth=0.5)
draw(above, spline, "C0", "spline", covariance)
above.plot(*spline.evaluate(seen).T, "x", color="0.3", label="cones seen")
below.plot(u, joint, label="joint covariance")
below.plot(u, marginals, "--", label="marginals only")
below.plot(u[::6], sampled[::6], "k.", label="2000 sampled splines")
below.set(xlabel="parameter [m]", ylabel="sigma across the curve [m]")
above.legend()
_ = below.legend()


# %% [markdown]
# ## Expansion
#
# Detections beyond the end mark an expansion. The curve is extended to the last of their proximity chain, and stays exactly as it was up
# to its old end. One update uses all the others.


# %%
def on_bend(along, inside):
    angle, radius = along / 30, 30 - inside
    return np.stack([radius * np.sin(angle), 30 - radius * np.cos(angle)], axis=1)


along, noise = np.linspace(-18, 0, 13), 0.04 * np.eye(2)
before, _ = fit_spline(on_bend(along, -0.03 * (along + 18)), 6, periodic=False)
sigma_before = posterior(before, np.linspace(*before.domain, 12), 0.5, 1.0)
detections = on_bend(np.array([-5.5, -2.6, 2.2, 4.6, 7.0]), np.array([0.1, 0.25, 0.3, 0.05, 0.2]))
foot_u = before.foot_points(detections).u
beyond = np.flatnonzero(beyond_end(detections, foot_u, before.domain[1], before.control_points, 2.0, 2.0))
order = beyond[proximity_chain(detections[beyond], before.control_points[-1])]

extended = before.extend_to(detections[order[-1]])
change = np.kron(end_change_matrix(before.knots, before.degree, extended.knots), np.eye(2))
sigma_extended = block_diag(change @ sigma_before @ change.T, noise)

others = np.delete(detections, order[-1], axis=0)
basis = extended.basis_matrix(extended.foot_points(others).u)
covariances = np.tile(noise, (len(others), 1, 1))
measured = fit_detections(basis, others, covariances, extended.control_points)
combine = np.kron(measured.range_basis(), np.eye(2)).T
H = combine @ np.kron(measured.taken, np.eye(2))
R = combine @ measured.covariance @ combine.T
gain = sigma_extended @ H.T @ np.linalg.inv(H @ sigma_extended @ H.T + R)
innovation = combine @ (measured.points - extended.control_points).ravel()
updated = extended.with_points(extended.control_points + (gain @ innovation).reshape(-1, 2))
sigma_updated = sigma_extended - gain @ H @ sigma_extended

figure, panels = plt.subplots(3, 1, figsize=(7, 7), sharex=True, layout="constrained")
steps = (before, sigma_before), (extended, sigma_extended), (updated, sigma_updated)
for axes, (curve, sigma), name in zip(panels, steps, ("before", "extended", "updated"), strict=True):
    draw(axes, curve, "C0", name, sigma)
    axes.plot(*others.T, "o", color="C2", markersize=4)
    axes.plot(*detections[beyond].T, "o", color="C3", markersize=4)
    axes.legend()

# %% [markdown]
# ## The fit of detections
#
# Detections beside the curve become one measurement of all its control points by a ridge regression. A control point whose basis function
# is zero at the closest points stays where it was.

# %%
x = 3.5 * np.arange(9)
curve = BSpline.open_uniform(np.stack([x, -3 * np.cos(2 * np.pi * x / x[-1])], axis=1), interval=3.5).clamp()
beside = curve.parameters_at(np.array([0.36, 0.47, 0.58, 0.68]) * curve.length())
readings = curve.evaluate(beside) + np.array([[0.5], [1.2], [1.3], [0.6]]) * curve.normal_unit(beside)
basis = curve.basis_matrix(curve.foot_points(readings).u)
covariances = np.tile(np.diag([0.05, 0.15]), (len(readings), 1, 1))
measurement = fit_detections(basis, readings, covariances, curve.control_points)
fitted = curve.with_points(measurement.points)

figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
draw(axes, curve, "C0", "curve of the state")
draw(axes, fitted, "C4", "curve fitted to the detections", measurement.covariance)
axes.plot(*readings.T, "o", color="C2", label="detections")
_ = axes.legend()

# %% [markdown]
# ## Simplification
#
# A closed curve of 100 control points becomes one of 32. Knots that follow the curvature keep it closer than uniform ones.

# %%
track = generate_track(np.random.default_rng(3), TrackGeneratorSettings(lap_length=(200, 260)))
old, _ = fit_spline(np.asarray(track.left), 100, periodic=True)
u = old.parameters_at(old.length() * (np.arange(1500) + 0.5) / 1500)
points = old.evaluate(u)


def simplified(baseline):
    breaks = curvature_weighted_breaks(old, 32, baseline, *old.domain)
    empty = BSpline.periodic_from(breaks, np.zeros((32, 2)), old.degree)
    return empty.with_points(LeastSquares(empty, u, SAMPLED_WEIGHT).solve(points))


weighted, uniform = simplified(0.5), simplified(1.0)
errors = [np.abs(new.foot_points(points).distance) for new in (weighted, uniform)]

figure, (above, below) = plt.subplots(2, 1, figsize=(7, 6), layout="constrained", height_ratios=(2, 1))
draw(above, old, "0.6", "100 control points")
draw(above, weighted, "C4", "32, by curvature")
for error, name in zip(errors, ("by curvature", "uniform"), strict=True):
    below.plot(100 * error, label=f"{name}: rms {100 * np.sqrt(np.mean(error**2)):.1f} cm")
below.set(xlabel="along the curve", ylabel="distance from the old one [cm]")
above.legend()
_ = below.legend()
