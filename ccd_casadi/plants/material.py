"""What elastic bodies are made of."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Material:
    """Isotropic linear elasticity; the defaults are those of aluminium 6061-T6.

    Attributes
    ----------
    young : float
        E in Pa.
    poisson : float
        Poisson's ratio.
    density : float
        kg/m³.
    """

    young: float = 68.9e9
    poisson: float = 0.33
    density: float = 2700.0

    @property
    def lame(self) -> tuple[float, float]:
        """λ and μ in Pa."""
        shear = self.young / (2.0 * (1.0 + self.poisson))
        return 2.0 * shear * self.poisson / (1.0 - 2.0 * self.poisson), shear
