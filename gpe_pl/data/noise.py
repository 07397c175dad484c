"""Training noise on windows of positions. Noisy velocities are consistent with noisy positions. Stored data are never changed.

A window has positions x[t−H … t+1] [history + 2, node, dim]. Both kinds of noise are added to positions. Velocities and the target acceleration follow from
the noisy window by the formulas of the integrator.

- Position noise: the same offset on every position, including the target's (paper, section 3.2). It does not change velocities and target.
- Velocity noise: a random walk over the H velocities, integrated to positions. The next velocity is the true one. The target therefore removes all of the
  velocity noise, but none of the position noise that follows from it [Sanchez-Gonzalez et al. 2020, as in their published code].

With ``Noise.correction``, the target also removes that fraction of the noise on the last position.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from gpe_pl.errors import GpeError
from gpe_pl.trajectory.trajectory import Metadata

MAX_SPACINGS = 0.5
"""Largest standard deviation of noise in rest spacings. With more noise, nodes change places with their neighbours."""
ROUNDING = 1e-5
"""Relative tolerance for a value that was copied, rounded, from a message."""


class NoiseError(GpeError, ValueError):
    """Raised for noise that is too large for the spacing of the data; the message names the key, its value and the largest allowed value."""


@dataclass(frozen=True)
class Noise:
    """Gaussian noise on the inputs of dynamic nodes.

    Attributes:
        position_of_domain: standard deviation of the position noise, as a fraction of the domain's longest side.
        velocity_of_change: standard deviation of the noise on the last velocity of a window, in units of one frame's velocity change, which is the root mean
            square acceleration without gravity × frame interval.
        correction: fraction of the noise on the last position that the target removes within the step [γ of Pfaff et al. 2021, appendix A.2.2]. With a value
            above 0, a model learns to correct positions. The paper uses 0.
    """

    position_of_domain: Annotated[float, Field(ge=0, le=1)] = 0.0
    velocity_of_change: Annotated[float, Field(ge=0, le=100)] = 0.3
    correction: Annotated[float, Field(ge=0, le=1)] = 0.0

    @property
    def is_any(self) -> bool:
        """Whether there is any noise."""
        return self.position_of_domain > 0 or self.velocity_of_change > 0

    def check(self, metadata: Metadata, velocity_unit: float = 0.0) -> None:
        """Check that the noise is not too large for the spacing of a data set.

        Args:
            metadata: metadata of the data set.
            velocity_unit: root mean square acceleration × frame interval [m/s]. With 0, if it is not known yet, velocity noise is not checked.

        Raises:
            NoiseError: the noise on positions, or on the displacement in one frame, has a standard deviation of more than ``MAX_SPACINGS`` spacings.
        """
        spacing = metadata.spacing
        for key, value, unit in (
            ("training.position_noise_of_domain", self.position_of_domain, metadata.longest_side),
            ("training.velocity_noise_of_change", self.velocity_of_change, velocity_unit * metadata.frame_dt),
        ):
            if value * unit > MAX_SPACINGS * spacing * (1 + ROUNDING):
                raise NoiseError(
                    f"{key}={value:g} moves nodes by {value * unit:.3g} m, which is {value * unit / spacing:.3g} spacings of {spacing:.3g} m; "
                    f"more than {MAX_SPACINGS:g} spacings are refused: choose at most {MAX_SPACINGS * spacing / unit:.6g}"
                )

    def apply(
        self,
        window: Float64[np.ndarray, "window node dim"],
        longest_side: float,
        velocity_unit: float,
        frame_dt: float,
        rng: np.random.Generator,
    ) -> Float64[np.ndarray, "window node dim"]:
        """Return a noisy copy of a position window, or the window itself if there is no noise.

        Args:
            window: positions x[t−H … t+1] in m.
            longest_side: longest side of the domain [m].
            velocity_unit: root mean square acceleration × frame interval [m/s].
            frame_dt: frame interval [s].
            rng: source of randomness.
        """
        if not self.is_any:
            return window
        offset = np.zeros_like(window)
        if self.position_of_domain:
            offset[:-1] = rng.normal(scale=self.position_of_domain * longest_side, size=window.shape[1:])
        if self.velocity_of_change:
            history = window.shape[0] - 2
            steps = rng.normal(scale=self.velocity_of_change * velocity_unit / np.sqrt(history), size=(history, *window.shape[1:]))
            offset[1:-1] += np.cumsum(np.cumsum(steps, axis=0) * frame_dt, axis=0)
        offset[-1] = (1 - self.correction) * offset[-2]
        return window + offset
