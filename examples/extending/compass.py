import gtsam
import numpy as np


def compass_factor(key: int, heading: float, sigma: float) -> gtsam.CustomFactor:
    """Return the factor `(theta - heading) / sigma` on a pose; headings are in the map frame (rad)."""

    def residual(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[np.ndarray] | None
    ) -> np.ndarray:
        if jacobians is not None:
            jacobians[0] = np.array([[0.0, 0.0, 1.0]], order="F")
        turn = values.atPose2(key).theta() - heading
        return np.array([np.arctan2(np.sin(turn), np.cos(turn))])

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, sigma), [key], residual)
