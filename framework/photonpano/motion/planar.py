"""The motion graph of homographies: what they do beyond shift and roll is a random walk, as wide as the capture shows.

A homography has eight numbers; most cameras move by fewer. From each exposure to the next one in time, the image shifts and
rolls by any amount. Its zoom, two shears and two perspectives are normally distributed, with variances that grow with the time
between both exposures, and that are estimated from the pairs: those of both shears are equal, and those of both perspectives,
since no direction of the image is another one than the rest. Where nothing zooms, the variance of the zoom goes to zero, and
with it the zoom. A camera that turns changes perspective in proportion to the shift, by -1 / f^2: this coupling is estimated,
too, and the walk is what perspective does beyond it.
"""

from __future__ import annotations

from itertools import accumulate
from typing import Literal, NamedTuple

import numpy as np
from scipy import sparse
from scipy.fft import dct
from scipy.sparse.linalg import SuperLU

from photonpano.geometry import corners, generators, inverse, parameters, scaled_ahead, transform_points, unit_coordinates
from photonpano.motion.adjustment import SAMPLES, Adjustment, Assessment, Prior, Problem, factorised, remembered
from photonpano.values import BoolArray, FloatArray, Homography

PlanarName = Literal["translation", "euclidean", "similarity", "affine", "homography"]

# The small motions of each model, by what they change of p1..p8 in unit coordinates.
_SHIFTS, _ROLL, _ZOOM = ({4: 1.0}, {5: 1.0}), {1: 1.0, 2: -1.0}, {0: 1.0, 3: 1.0}
_SHEARS, _PERSPECTIVES = ({0: 1.0, 3: -1.0}, {1: 1.0, 2: 1.0}), ({6: 1.0}, {7: 1.0})
_MOVED: dict[PlanarName, tuple[dict[int, float], ...]] = {
    "translation": _SHIFTS,
    "euclidean": (*_SHIFTS, _ROLL),
    "similarity": (*_SHIFTS, _ROLL, _ZOOM),
    "affine": (*_SHIFTS, _ROLL, _ZOOM, *_SHEARS),
    "homography": (*_SHIFTS, _ROLL, _ZOOM, *_SHEARS, *_PERSPECTIVES),
}
PLANAR_NAMES: tuple[PlanarName, ...] = tuple(_MOVED)
_FREE = 3  # the first of these motions have no prior
# The walks, by which of the other motions they change. Each model but translations has one more of them than that before.
_WALKS = {"zoom": slice(0, 1), "shear": slice(1, 3), "perspective": slice(3, 5)}
_TERMS = 12  # of the exponential and the logarithmic series
_HALVINGS = 2  # of a logarithm, by square roots, before its series
_ROOTS = 8  # Newton steps of a square root
# Standard deviations of a walk over the whole capture, in units of half a frame: at first, when robust weights must not blame
# pairs for a motion that the prior hinders; where the capture is too short to tell; and below which it is none (0.005 px).
_FIRST, _ASSUMED, _NONE = 1.0, 0.02, 2e-5
_FEWEST_STEPS = 3  # that tell how wide the walks are
_ROUNDS, _MOST, _SETTLED = 12, 6.0, 0.1  # rounds; most change of the logarithm of a variance in one, and least that counts
# By how much a walk must lower the deviance: as the prior of a number does whose square is twice its variance (Akaike 1974).
_WORTH = 1 - float(np.log(2))
_BEND = 1e-6  # coupling by whose effect its derivative is taken
_DRAWS = 24  # by which the variances' degrees of freedom are estimated


def basis_of(model: PlanarName) -> FloatArray:
    """Return the small motions of a model: (8, k) changes of p1..p8 in unit coordinates."""
    basis = np.zeros((8, len(_MOVED[model])))
    for column, changes in enumerate(_MOVED[model]):
        for row, change in changes.items():
            basis[row, column] = change
    return basis


def moved(homographies: FloatArray, steps: FloatArray, basis: FloatArray, frame_shape: tuple[int, int]) -> Homography:
    """Return homographies after a motion of each frame, (N, k) along the (8, k) basis: it stays within the group."""
    change = np.einsum("nk,pk,pij->nij", steps, basis, generators(frame_shape))
    term = total = np.broadcast_to(np.eye(3), change.shape)
    for order in range(1, _TERMS + 1):
        term = term @ change / order
        total = total + term
    return scaled_ahead(homographies @ total)


def logarithms(motions: Homography, frame_shape: tuple[int, int]) -> FloatArray:
    """Return the small motions, in p1..p8 of unit coordinates, of which (N, 3, 3) homographies are the exponentials: (N, 8)."""
    root: FloatArray = motions / np.cbrt(np.linalg.det(motions))[:, None, None]
    for _ in range(_HALVINGS):
        other = np.broadcast_to(np.eye(3), root.shape)
        for _ in range(_ROOTS):  # Denman and Beavers 1976
            root, other = (root + np.linalg.inv(other)) / 2, (other + np.linalg.inv(root)) / 2
    away = root - np.eye(3)
    term, total = away, away
    for order in range(2, _TERMS + 1):
        term = -term @ away
        total = total + term / order
    return _coordinates(total * 2**_HALVINGS, frame_shape)


def _coordinates(changes: FloatArray, frame_shape: tuple[int, int]) -> FloatArray:
    """Return the p1..p8, in unit coordinates, of small changes of pixels: (..., 3, 3) to (..., 8)."""
    unit = unit_coordinates(frame_shape)
    changes = unit @ changes @ np.linalg.inv(unit)
    return parameters(changes + (1 - changes[..., 2:, 2:]) * np.eye(3))


def nearest(model: PlanarName, homographies: Homography, frame_shape: tuple[int, int]) -> Homography:
    """Return the motions of a model that move the corners of a frame most like (N, 3, 3) homographies, by least squares."""
    if model == "homography":
        return homographies
    here, there = corners(frame_shape), transform_points(homographies, corners(frame_shape))
    middle, moved_middle = here.mean(axis=0), there.mean(axis=1)
    away, moved_away = here - middle, there - moved_middle[:, None]
    found = np.broadcast_to(np.eye(3), homographies.shape).copy()
    if model == "affine":
        found[:, :2, :2] = (
            np.linalg.lstsq(away, np.moveaxis(moved_away, 0, -1).reshape(4, -1), rcond=None)[0]
            .reshape(2, 2, -1)
            .transpose(2, 1, 0)
        )
    elif model != "translation":
        # As complex numbers, a roll and a zoom are one factor.
        first, second = away @ [1, 1j], moved_away @ [1, 1j]
        factor = second @ first.conj() / (np.abs(first) ** 2).sum()
        if model == "euclidean":
            factor = factor / np.abs(factor)
        found[:, 0, 0], found[:, 0, 1] = factor.real, -factor.imag
        found[:, 1, 0], found[:, 1, 1] = factor.imag, factor.real
    found[:, :2, 2] = moved_middle - np.einsum("nij,j->ni", found[:, :2, :2], middle)
    return found


class Plane(NamedTuple):
    """The homographies of the exposures of a graph."""

    homographies: FloatArray  # (N, 3, 3) to the anchor's frame
    coupling: float = 0.0  # perspective that a shift brings along, in unit coordinates: -(s / f)^2 for a camera that turns


class _Around(NamedTuple):
    """The linear problem around a state, for any variances of the components of its prior.

    Right sides have columns: that of the solution, and draws of its error.
    """

    normal: sparse.csr_array  # of the edges
    right: FloatArray  # (n, 1 + D) of the edges
    parts: list[Prior]  # the components, before they are divided by their standard deviations
    squares: list[sparse.csr_array]  # of their slopes
    sides: list[FloatArray]  # (n, 1 + D) each

    def factors(self, variances: FloatArray) -> SuperLU:
        """Factorise the normal equations."""
        return factorised(self.normal + sum(square / each for square, each in zip(self.squares, variances, strict=True)))

    def given(self, variances: FloatArray) -> FloatArray:
        """Return the right sides of these equations: (n, 1 + D)."""
        scales = np.ones((len(variances), self.right.shape[1])) / np.sqrt(variances)[:, None]
        scales[:, 0] **= 2
        return np.asarray(self.right + sum(side * scale for side, scale in zip(self.sides, scales, strict=True)))

    def deviance(self, variances: FloatArray) -> float:
        """Return that of the solution: see `Adjustment`."""
        factors = self.factors(variances)
        known = sum(float(part.residuals @ part.residuals) / each for part, each in zip(self.parts, variances, strict=True))
        given = self.right[:, 0] + sum(side[:, 0] / each for side, each in zip(self.sides, variances, strict=True))
        determinant = float(np.log(np.abs(factors.U.diagonal())).sum())
        numbers = [len(part.residuals) for part in self.parts]
        return float(known - given @ factors.solve(given) + determinant + numbers @ np.log(variances))


class PlanarAdjustment(Adjustment[Plane]):
    """The least-squares problem of a graph of homographies.

    The unknowns of a node are those of a small motion of its own frame, in coordinates of about unit size. All share the
    coupling of perspective to shift, where the model has both.

    Attributes:
        variances: of the prior, in squares of unit coordinates: of each walk per frame, (w,), and then of the coupling.
    """

    def __init__(self, problem: Problem, model: PlanarName, *, bends: bool = False) -> None:
        """Set up the problem; `bends` has a model without perspective share the coupling, too."""
        self._problem, self._model, self._basis = problem, model, basis_of(model)
        self._walks = [columns for columns in _WALKS.values() if columns.stop <= self._basis.shape[1] - _FREE]
        self._n_walks = len(self._walks)
        self._bends = bends
        super().__init__(problem, n_shared=int(model == "homography" or bends))
        # Nodes are in order of time; those of one instant make no step.
        self._times = np.maximum(np.diff(problem.instants), 1.0)
        self._durations = np.array([max(float(self._times.sum()), 1.0)] * self._n_walks + [1.0] * self._n_shared)
        self.variances = _FIRST**2 / self._durations
        self._of_coupling = np.inf  # variance of the estimated coupling

    def of(self, problem: Problem, model: PlanarName | None = None) -> PlanarAdjustment:
        """Return the same for other pairs, or for a narrower model, with the variances of these walks."""
        found = PlanarAdjustment(problem, model or self._model)
        found.variances, found._noise_norm = self.variances[: found._n_walks + found._n_shared], self._noise_norm
        return found

    @property
    def _n_node(self) -> int:
        return int(self._basis.shape[1])

    @property
    def walks_px(self) -> dict[str, float]:
        """How far each walk moves the ends of a frame over the capture, in px: a standard deviation; none that are 0."""
        ends_px = np.sqrt(self.variances * self._durations) * self._half
        return {name: float(px) for name, px in zip(_WALKS, ends_px[: self._n_walks], strict=False) if px > _NONE * self._half}

    @property
    def only_rolls(self) -> bool:
        """Whether all that nodes do beside shifts is roll."""
        return self._n_node == _FREE

    @property
    def n_hyperparameters(self) -> int:
        """How many variances were estimated."""
        return int((self.variances > _NONE**2 / self._durations).sum())

    def homographies(self, state: Plane) -> FloatArray:
        """Return those of the state."""
        return state.homographies

    def changed(self, state: Plane, nodes: FloatArray, shared: FloatArray) -> Plane:
        """Return the homographies after a step."""
        return Plane(moved(state.homographies, nodes, self._basis, self._frame_shape), state.coupling + float(shared.sum()))

    def anchored(self, state: Plane) -> Plane:
        """Return the homographies, of which the anchor's is the identity."""
        state.homographies[self._anchor] = np.eye(3)
        return state

    def generators(self, state: Plane) -> FloatArray:
        """Return those of the model in unit coordinates: (k, 3, 3)."""
        del state
        return np.asarray(np.einsum("pk,pij->kij", self._basis, generators(self._frame_shape)))

    def prior(self, state: Plane) -> Prior:
        """Return the steps of the walks from each node to the next, and the coupling."""
        if not (parts := self._components(state)):
            return super().prior(state)
        stds = np.repeat(np.sqrt(self.variances), [len(part.residuals) for part in parts])
        residuals = np.concatenate([part.residuals for part in parts]) / stds
        rows = sparse.csr_array(sparse.diags_array(1 / stds) @ sparse.vstack([part.slopes for part in parts]))
        times = max(self._n_node - _FREE, 0) * float(np.log(self._times).sum())
        return Prior(residuals, rows, float(2 * np.log(stds).sum()) + times)

    def learn(self, state: Plane, weights: FloatArray) -> bool:
        """Estimate the variances of the prior from pairs of these weights, (E,); return whether they changed.

        Variance components of least squares (Foerstner 1979; MacKay 1992): the sum of the squared steps, over the number of
        them that the pairs determine. The marginal likelihood is largest where this changes nothing. A walk that hardly
        raises it is none.
        """
        if not self._n_walks:
            return False
        if len(self._times) < _FEWEST_STEPS:
            assumed = np.where(np.arange(len(self._durations)) < self._n_walks, _ASSUMED, _NONE)
            changed = assumed**2 / self._durations != self.variances
            self.variances = assumed**2 / self._durations
            return bool(changed.any())
        before, problem = self.variances, self._around(state, weights)
        # The variance of the last shared unknown, the coupling, is exact; others are those of draws.
        alone = np.zeros((problem.right.shape[0], 1))
        alone[-1], last = self._n_shared, np.zeros(len(before))
        for _ in range(_ROUNDS):
            given = np.column_stack([problem.given(self.variances), alone])
            changes = problem.factors(self.variances).solve(given)
            found = np.empty(len(before))
            for index, (part, variance) in enumerate(zip(problem.parts, self.variances, strict=True)):
                moves, number = part.slopes @ changes, len(part.residuals)
                left = part.residuals - moves[:, 0]
                unsure = (moves[:, 1:-1] ** 2).sum() / _DRAWS if index < self._n_walks else changes[-1, -1]
                found[index] = (left @ left) / max(number - unsure / variance, 1e-3 * number)
            # Steps that go on in one direction, as those to zero, are doubled.
            self._of_coupling = float(changes[-1, -1])
            step = np.log(np.maximum(found / self.variances, np.exp(-_MOST)))
            step, last = np.clip(np.where(step * last > 0, 2 * step, step), -_MOST, _MOST), step
            step = np.maximum(step, np.log(_NONE**2 / self._durations / self.variances))
            self.variances = self.variances * np.exp(step)
            if np.abs(step).max() < _SETTLED:
                break
        least = problem.deviance(self.variances)
        for index in range(self._n_walks):  # none by which errors become larger
            without = self.variances.copy()
            without[index] = _NONE**2 / self._durations[index]
            if without[index] < self.variances[index] and (other := problem.deviance(without)) < least + _WORTH:
                self.variances, least = without, other
        return bool(np.abs(np.log(self.variances / before)).max() > _SETTLED)

    def widened(self, state: Plane, weights: FloatArray) -> PlanarAdjustment | None:
        """Return the problem with walks as wide at all time scales as in the octave of these in which they are widest.

        None if it has no walks, or too few steps to tell.

        Most cameras move more smoothly than a walk: one that is as wide as all scales are in the mean holds the slow ones, in
        which most of the motion is, and bends a long path. Expected squares of the steps (Dempster et al. 1977).
        """
        if not self._n_walks or len(self._times) < _FEWEST_STEPS:
            return None
        problem, found = self._around(state, weights), self.of(self._problem)
        changes = problem.factors(self.variances).solve(problem.given(self.variances))
        octaves = np.array([0, *(2 ** np.arange((len(self._times) - 1).bit_length()))])
        found.variances, found._of_coupling = self.variances.copy(), self._of_coupling
        for index, part in enumerate(problem.parts[: self._n_walks]):
            steps = -(part.slopes @ changes)
            steps[:, 0] += part.residuals
            squares = dct(steps.reshape(len(self._times), -1, steps.shape[1]), axis=0, norm="ortho") ** 2
            expected = (squares[..., 0] + squares[..., 1:].mean(axis=-1)).mean(axis=-1)
            of_octaves = np.add.reduceat(expected, octaves) / np.diff(octaves, append=len(expected))
            found.variances[index] = max(float(of_octaves.max()), self.variances[index])
        return found

    def _around(self, state: Plane, weights: FloatArray) -> _Around:
        free, rng = self._free(state), np.random.default_rng(0)
        jacobians, residuals = self._of_edges(state, weights)
        jacobians = jacobians[:, free]
        drawn = jacobians.T @ rng.normal(size=(jacobians.shape[0], _DRAWS))
        parts = [Prior(part.residuals, sparse.csr_array(part.slopes[:, free])) for part in self._components(state)]
        sides = [
            part.slopes.T @ np.column_stack([part.residuals, rng.normal(size=(len(part.residuals), _DRAWS))]) for part in parts
        ]
        squares = [sparse.csr_array(part.slopes.T @ part.slopes) for part in parts]
        return _Around(jacobians.T @ jacobians, np.column_stack([jacobians.T @ residuals, drawn]), parts, squares, sides)

    def assess_beside_turns(self, state: Plane, norms: FloatArray, kept: BoolArray) -> Assessment:
        """Assess a solution whose perspective may have been missed: that of a camera that turns bends a long path.

        As many of the drawn errors as it is likely that perspective follows the shift (weights of Akaike) are those with it.
        """
        own = self.assess(state, norms, kept)
        if self._n_shared:
            return own
        bent = PlanarAdjustment(self._problem, self._model, bends=True)
        bent._noise_norm, bent.variances = self._noise_norm, np.append(self.variances, 1.0)
        jacobians, residuals = bent._linearised(state, bent.weights(norms, kept))
        free = bent._free(state)
        normal, changes = (jacobians.T @ jacobians)[free][:, free], np.zeros((len(free), 2))
        right = np.column_stack([-jacobians.T @ residuals, np.eye(len(free))[:, -1]])
        changes[free] = factorised(normal).solve(right[free])
        (coupling, variance), likely = changes[-1], bent.assess(state, norms, kept)
        drawn = round(SAMPLES / (1 + float(np.exp(1 - coupling**2 / variance / 2))))
        away = bent._corner_errors_px(state, changes[:, :1])
        for mine, theirs in ((own.errors_px, likely.errors_px), (own.shared_px, likely.shared_px)):
            mine[..., :drawn] = theirs[..., :drawn] + away
        return own

    def shared_slopes(self, state: Plane) -> FloatArray:
        """Return the derivatives of the corners that each edge maps by the coupling, which the path follows."""
        if not self._bends:
            return super().shared_slopes(state)
        there = self.mapped_corners(Plane(self._bent(state))) - self.mapped_corners(state)
        return np.asarray(there.reshape(-1, 8, 1) / _BEND)

    def shared_errors(self, state: Plane) -> FloatArray:
        """Return the derivatives of the corners of each node's frame by the coupling."""
        if not self._bends:
            return super().shared_errors(state)
        there = transform_points(inverse(state.homographies) @ self._bent(state), self._corners) - self._corners
        return np.asarray(there.reshape(-1, 8, 1) / _BEND)

    def _bent(self, state: Plane) -> Homography:
        """Return the homographies of a path of the same shifts and rolls, along which perspective follows the shift."""
        relative = inverse(state.homographies[:-1]) @ state.homographies[1:]
        perspective = _BEND * logarithms(relative, self._frame_shape)[:, 4:6]
        steps = moved(relative, perspective, basis_of("homography")[:, -2:], self._frame_shape)
        return np.stack(list(accumulate(steps, lambda before, step: scaled_ahead(before @ step), initial=np.eye(3))))

    def narrowed(self, state: Plane) -> tuple[PlanarAdjustment, Plane]:
        """Return the problem without walks that are none, and the nearest state that it holds."""
        there = self.variances > _NONE**2 / self._durations
        model = PLANAR_NAMES[1 + min(int(np.flatnonzero(there).max(initial=-1)) + 1, len(_WALKS))]
        if len(_MOVED[model]) >= self._n_node:
            return self, state
        return self.of(self._problem, model), Plane(nearest(model, state.homographies, self._frame_shape))

    @property
    def is_coupled(self) -> bool:
        """Whether perspective follows the shift (Schwarz 1978), as that of a camera that turns, or has a lens."""
        return bool(self._n_shared and self.variances[-1] > self._of_coupling * self.price)

    def turning_px(self, state: Plane) -> float | None:
        """Return the focal length of a camera that turns; None unless perspective follows the shift."""
        return self._half / float(np.sqrt(-state.coupling)) if self.is_coupled and state.coupling < 0 else None

    @remembered
    def _components(self, state: Plane) -> list[Prior]:
        """Return the steps of each walk beyond the coupling, over the roots of their times; and the coupling."""
        n_steps, k = len(self._times), self._n_node
        w = max(k - _FREE, 0)
        if not w and not self._n_shared:
            return []
        perspective = self._model == "homography"
        relative = inverse(state.homographies[:-1]) @ state.homographies[1:]
        motions = logarithms(relative, self._frame_shape)
        back = np.linalg.pinv(self._basis)[_FREE:]  # from p1..p8 to the walks
        moves = generators(self._frame_shape)
        earlier = _coordinates(inverse(relative)[:, None] @ moves @ relative[:, None], self._frame_shape)
        by_nodes = np.stack([-back @ np.swapaxes(earlier, 1, 2), np.broadcast_to(back, (n_steps, w, 8))], axis=2) @ self._basis
        steps, roots = motions @ back.T, 1 / np.sqrt(self._times)
        by_coupling = np.zeros((n_steps, w))
        if perspective:
            by_coupling[:, _WALKS["perspective"]] = -motions[:, 4:6]
            steps += state.coupling * by_coupling
            shifts = np.eye(8)[4:6]
            of_shift = np.stack([-shifts @ np.swapaxes(earlier, 1, 2), np.broadcast_to(shifts, (n_steps, 2, 8))], axis=2)
            by_nodes[:, _WALKS["perspective"]] -= state.coupling * (of_shift @ self._basis)
        parts = []
        for walk in self._walks:
            changes = by_nodes[:, walk].reshape(n_steps, -1, 2 * k) * roots[:, None, None]
            rows = np.repeat(np.arange(changes[..., 0].size), 2 * k)
            columns = np.broadcast_to(k * np.arange(n_steps)[:, None, None] + np.arange(2 * k), changes.shape)
            slopes = sparse.csr_array((changes.ravel(), (rows, columns.ravel())), shape=(rows[-1] + 1, k * self._n_nodes))
            if self._n_shared:
                beside = (by_coupling[:, walk] * roots[:, None]).reshape(-1, 1)
                slopes = sparse.csr_array(sparse.hstack([slopes, sparse.csr_array(beside)]))
            parts.append(Prior((steps[:, walk] * roots[:, None]).ravel(), slopes))
        if self._n_shared:
            parts.append(Prior(np.array([state.coupling]), self._of_shared(np.ones((1, 1)))))
        return parts

    def information(self, state: Plane, blocks: FloatArray) -> FloatArray:
        """Convert (N, k, k) information on changes of nodes to that on p1..p8 of their homographies.

        What the model does not move is as sure as all that it does together.
        """
        back = np.linalg.pinv(self._basis)
        fixed = np.eye(8) - self._basis @ back
        blocks = back.T @ blocks @ back + np.trace(blocks, axis1=1, axis2=2)[:, None, None] * fixed
        changed = state.homographies[:, None] @ generators(self._frame_shape)
        slopes = changed - state.homographies[:, None] * changed[..., 2:, 2:]
        to_parameters = parameters(np.eye(3) + slopes).transpose(0, 2, 1)
        to_change = np.linalg.inv(to_parameters)
        return np.asarray(to_change.transpose(0, 2, 1) @ blocks @ to_change)
