"""Normal equations of a whole log: a long chain of poses, bordered by the map that all of them see.

    [ A  B ] [dx]   [a]       A: poses, block-tridiagonal        x: poses, oldest first
    [ B' C ] [dy] = [b]       C: map and calibration, dense      y: what every pose may share a row with

Poses are eliminated by a banded Cholesky factor, what is left on the border by a dense one: the time is
linear in the number of poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from .window import POSE, SingularSystemError, cholesky, solve

Array = NDArray[np.float64]

BANDS = 2 * POSE
"""Rows of the banded storage: the diagonal and the lower ones of a block-tridiagonal matrix."""


@dataclass(frozen=True, eq=False)
class Arrowhead:
    """`[[A, B], [B', C]]` and the negative gradient `[a, b]`."""

    diagonal: Array
    """(P, 3, 3) diagonal blocks of A."""
    following: Array
    """(P - 1, 3, 3) blocks of A below the diagonal: row of the next pose, column of the pose."""
    coupling: Array
    """(3 P, n) B."""
    border: Array
    """(n, n) C."""
    descent_poses: Array
    """(3 P,) a."""
    descent_border: Array
    """(n,) b."""

    @property
    def scale_poses(self) -> Array:
        """(3 P,) diagonal of A."""
        return np.asarray(np.diagonal(self.diagonal, axis1=1, axis2=2)).reshape(-1)

    @property
    def scale_border(self) -> Array:
        """(n,) diagonal of C."""
        return np.diagonal(self.border).copy()

    def banded(self) -> Array:
        """A in LAPACK's lower banded storage (6, 3 P): row d holds the d-th diagonal below the main one."""
        count = len(self.diagonal)
        band = np.zeros((BANDS, POSE * count), order="F")
        for j in range(POSE):
            for i in range(j, POSE):
                band[i - j, j::POSE] = self.diagonal[:, i, j]
            for i in range(POSE):
                band[POSE + i - j, j : POSE * (count - 1) : POSE] = self.following[:, i, j]
        return band

    def dense(self) -> tuple[Array, Array]:
        """The whole matrix and right side, border first: for tests of small systems."""
        n, poses = len(self.border), POSE * len(self.diagonal)
        chain = np.zeros((poses, poses))
        for k, block in enumerate(self.diagonal):
            chain[POSE * k : POSE * (k + 1), POSE * k : POSE * (k + 1)] = block
        for k, block in enumerate(self.following):
            chain[POSE * (k + 1) : POSE * (k + 2), POSE * k : POSE * (k + 1)] = block
            chain[POSE * k : POSE * (k + 1), POSE * (k + 1) : POSE * (k + 2)] = block.T
        matrix = np.zeros((n + poses, n + poses))
        matrix[:n, :n], matrix[n:, n:] = self.border, chain
        matrix[n:, :n], matrix[:n, n:] = self.coupling, self.coupling.T
        return matrix, np.concatenate([self.descent_border, self.descent_poses])

    def factor(self) -> Array:
        """(6, 3 P) lower banded L with `A = L L'`; SingularSystemError where there is none."""
        chain, info = lapack.dpbtrf(self.banded(), lower=1, overwrite_ab=1)
        if info != 0:
            raise SingularSystemError(f"expected a positive definite chain, found pivot {info} not positive")
        return np.asarray(chain)

    def poses_alone(self) -> Array:
        """(3 P,) `A^-1 a`: the poses' solution beside a border that is held."""
        step, _ = lapack.dpbtrs(self.factor(), self.descent_poses[:, None], lower=1)
        return np.asarray(step[:, 0])

    def reduced(self) -> Reduced:
        """`A = L L'` and `C - B' A^-1 B`; SingularSystemError where A isn't positive definite."""
        chain = self.factor()
        columns = np.empty((len(self.coupling), len(self.border) + 1), order="F")
        columns[:, :-1], columns[:, -1] = self.coupling, self.descent_poses
        half, _ = lapack.dtbtrs(chain, columns, uplo="L", overwrite_b=1)
        gram = blas.dsyrk(1.0, half, trans=1, lower=1)
        gram = np.tril(gram) + np.tril(gram, -1).T
        return Reduced(chain, half, self.border - gram[:-1, :-1], self.descent_border - gram[:-1, -1])


def empty_arrowhead(poses: int, border: int) -> Arrowhead:
    """Zeros for so many poses and so many entries of the border."""
    return Arrowhead(
        diagonal=np.zeros((poses, POSE, POSE)),
        following=np.zeros((max(poses - 1, 0), POSE, POSE)),
        coupling=np.zeros((POSE * poses, border), order="F"),
        border=np.zeros((border, border)),
        descent_poses=np.zeros(POSE * poses),
        descent_border=np.zeros(border),
    )


@dataclass(frozen=True, eq=False)
class Reduced:
    """An arrowhead whose poses are eliminated."""

    chain: Array
    """(6, 3 P) L, lower banded."""
    half: Array
    """(3 P, n + 1) L^-1 [B, a]."""
    border: Array
    """(n, n) C - B' A^-1 B."""
    descent: Array
    """(n,) b - B' A^-1 a."""

    def step(self, damping: Array) -> tuple[Array, Array]:
        """The solution with (n, n) added to C: (3 P,) of the poses and (n,) of the border.

        SingularSystemError where that isn't positive definite.
        """
        border = solve(cholesky(self.border + damping), self.descent)
        return self.poses(border), border

    def poses(self, border: Array) -> Array:
        """(3 P,) `A^-1 (a - B y)`: the poses' solution beside that of the border (n,), zero to hold it."""
        right = self.half[:, -1] - self.half[:, :-1] @ border
        poses, _ = lapack.dtbtrs(self.chain, right[:, None], uplo="L", trans="T")
        return np.asarray(poses[:, 0])

    def border_covariance(self) -> Array:
        """(n, n) `(C - B' A^-1 B)^-1`: the border's block of the inverse."""
        inverse, _ = lapack.dpotri(cholesky(self.border), lower=1)
        return np.asarray(np.tril(inverse) + np.tril(inverse, -1).T)

    def pose_marginals(self) -> Array:
        """(P, 3, 3) diagonal blocks of the inverse: `A^-1_kk + (A^-1 B)_k Sigma (A^-1 B)_k'`, never dense.

        Sigma is the border's covariance.
        """
        gain, _ = lapack.dtbtrs(self.chain, self.half[:, :-1], uplo="L", trans="T")
        blocks = gain.reshape(-1, POSE, gain.shape[1])
        carried = (gain @ self.border_covariance()).reshape(blocks.shape)
        return np.asarray(self._chain_marginals() + np.einsum("pin,pjn->pij", carried, blocks))

    def _chain_marginals(self) -> Array:
        """(P, 3, 3) diagonal blocks of A^-1, from the last to the first.

        With `L_k` on L's diagonal and `M_k` below: `S_k = L_k^-T (I + M_k' S_{k+1} M_k) L_k^-1`.
        """
        own, below = self._blocks()
        inverse = np.linalg.inv(own)
        marginals = np.empty_like(own)
        following = np.zeros((POSE, POSE))
        for k in range(len(own) - 1, -1, -1):
            inner = np.eye(POSE) + below[k].T @ following @ below[k]
            following = inverse[k].T @ inner @ inverse[k]
            marginals[k] = following
        return marginals

    def _blocks(self) -> tuple[Array, Array]:
        """(P, 3, 3) lower-triangular blocks on L's diagonal and (P, 3, 3) those below, the last one zero."""
        count = self.chain.shape[1] // POSE
        own, below = np.zeros((count, POSE, POSE)), np.zeros((count, POSE, POSE))
        for j in range(POSE):
            for i in range(j, POSE):
                own[:, i, j] = self.chain[i - j, j::POSE]
            for i in range(POSE):
                below[:-1, i, j] = self.chain[POSE + i - j, j : POSE * (count - 1) : POSE]
        return own, below
