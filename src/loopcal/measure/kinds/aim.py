# SPDX-License-Identifier: Apache-2.0
"""What kinds share that look at directions: an axis of the platform from a frame, or gravity from
the platform.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from loopcal import geometry
from loopcal.measure.closed_form import directions
from loopcal.measure.kinds import parts
from loopcal.measure.kinds.kind import Evaluation, Kind
from loopcal.measure.kinds.tool import stacked
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class AimKind(Kind):
    """A kind that is a function of a direction `d = S' Q a`: S an orientation, a a direction,
    either known or not.

    Outward, Q = R, the platform's rotation: a is an axis of the platform, S the orientation of an
    instrument in the base. Inward, Q = R': a is a direction of the base (gravity), S the mounting
    of a sensor on the platform. With s the turn of S: `dd = S' (dQ a) + S' Q da + S' (Q a x s)`,
    where `dR a = omega x R a`, `dR' a = R' (a x omega)`.

    Parameters
    ----------
    unknown : tuple of str
        Which of `allowed_unknown`, (orientation, direction), are unknown; three and two numbers, one value
        for a session.
    """

    unknown: tuple[str, ...] = ()

    allowed_unknown: ClassVar[tuple[str, str]] = ("frame", "axis")
    inward: ClassVar[bool] = False

    @property
    @abstractmethod
    def stated(self) -> tuple[str, FloatArray, str, FloatArray]:
        """Name and rotation (3, 3) of the orientation, name and unit vector (3,) of the direction."""

    @property
    def setup_items(self) -> Mapping[str, tuple[Parameter, ...]]:
        """Turns of the orientation and of the direction, as far as they are unknown."""
        turned, _, pointed, _ = self.stated
        both = {
            self.allowed_unknown[0]: parts.turn_part(turned),
            self.allowed_unknown[1]: parts.direction_part(pointed),
        }
        return {name: both[name] for name in self.unknown}

    @property
    def references(self) -> Mapping[str, FloatArray]:
        """The stated orientation and direction."""
        turned, S, pointed, a = self.stated
        both = {self.allowed_unknown[0]: (turned, S), self.allowed_unknown[1]: (pointed, a)}
        return dict(both[name] for name in self.unknown)

    def direction(self, T: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The direction d (.., 3) and its derivative (.., 3, 6 + u)."""
        _, S, _, a = self.stated
        turn, point = (self.item_values(values, name) for name in self.allowed_unknown)
        R = T[..., :3, :3]
        Q = np.swapaxes(R, -1, -2) if self.inward else R
        if turn is not None:
            S = geometry.exp_so3(turn) @ S
        St = np.swapaxes(S, -1, -2)
        a = parts.direction_at(a, point)
        seen = (Q @ a[..., None])[..., 0]
        by_omega = Q @ geometry.hat(a) if self.inward else -geometry.hat(seen)
        by_omega = St @ by_omega
        blocks = {"twist": np.concatenate([by_omega, np.zeros_like(by_omega)], axis=-1)}
        if turn is not None:
            blocks[self.allowed_unknown[0]] = (
                St @ geometry.hat(seen) @ geometry.left_jacobian_so3(turn)
            )
        if point is not None:
            blocks[self.allowed_unknown[1]] = St @ Q @ parts.direction_slope(self.stated[3], point)
        d = (St @ seen[..., None])[..., 0]
        return d, self.columns_of(blocks, d.shape)

    @abstractmethod
    def predict(self, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Columns (.., m) of directions d (.., 3), and their slopes (.., m, 3)."""

    @abstractmethod
    def directions(self, measured: FloatArray) -> FloatArray:
        """Unit vectors d (.., 3) of columns (.., c)."""

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        d, rows = self.direction(T, values)
        predicted, slopes = self.predict(d)
        return self.split(geometry.wrap_angle(predicted - measured), slopes @ rows)

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        unknowns: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Columns (t, r, c) with noise added."""
        return self.predict(self.direction(T, self.values(unknowns))[0])[0] + noise

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Orientation and direction in closed form, from the whole group of rotations."""
        whole = ~np.any(np.isnan(measured), axis=-1)
        if not self.unknown or np.count_nonzero(whole) < 3:
            return self.nominal_values[None]
        _, S, _, a = self.stated
        Q = T[whole, :3, :3]
        if self.inward:
            Q = np.swapaxes(Q, -1, -2)
        return np.concatenate(
            [self._found(Q, S, a, seen) for seen in self.readings(measured[whole])]
        )

    def readings(self, measured: FloatArray) -> tuple[FloatArray, ...]:
        """All the directions (r, 3) that columns (r, c) may stand for."""
        return (self.directions(measured),)

    def _found(self, Q: FloatArray, S: FloatArray, a: FloatArray, seen: FloatArray) -> FloatArray:
        """Candidates (k, u) from directions seen (r, 3)."""
        turned, pointed = (name in self.unknown for name in self.allowed_unknown)
        if turned:
            turns, points = directions(seen, Q, None if pointed else a)
        else:
            mean = np.einsum("rji,jk,rk->i", Q, S, seen)
            turns, points = S[None], (mean / np.linalg.norm(mean))[None]
        found = {
            self.allowed_unknown[0]: parts.turn_values(S, turns),
            self.allowed_unknown[1]: parts.direction_values(a, points),
        }
        return stacked(self, found, len(turns))
