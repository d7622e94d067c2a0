"""|S| of several channels, or of one with many modes, over frequencies and a box of plants.

At one frequency each mode enters the plant once, with a matrix of rank one, so that the set of
plants is a sum of one region per mode. Each is enclosed by a disc; the work grows with their number
and not with that of the boxes' corners. With K = K̂/y, y as in `enclosure`,

    S = y M⁻¹,   M = y + Σ_i g_i c_i b_iᵀ K̂,   g_i ∈ m_i + r_i {|e| <= 1}

A mode of large r_i is taken as it is: with the others at their centres,

    M⁻¹ = X - γ (X c)(bᵀK̂ X),   γ = g/(1 + g bᵀK̂ X c),   X = (y + Σ_others)⁻¹

where γ lies in a disc too, and ‖M⁻¹‖, convex in γ, is largest at a corner of a polygon around it.
What is left has ‖Σ δ_i c_i b_iᵀK̂‖² <= ‖Σ r_i a_i c_i c_iᵀ‖ ‖Σ r_i/a_i (b_iᵀK̂)*(b_iᵀK̂)‖ and is taken
off the least singular value of M; so are y and K̂ over the range of frequency. (Discs of modes in
the Nyquist plane: Delissen, van Keulen and Langelaar 2023; zero exclusion as in `enclosure`.)
"""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.fixed_structure.affine import Affine, inverse
from ccd_casadi.fixed_structure.enclosure import Boxes, Chart, Enclosures, LoopFamily
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.support.arrays import Array

# of a polygon around a disc, and a little for the rounding of the disc itself
CORNERS = (1.0 + 1e-9) * np.exp(2j * np.pi * np.arange(8) / 8) / np.cos(np.pi / 8)
TURNS = np.exp(1j * np.pi * np.arange(-2, 3) / 4)  # half planes that 1/D is looked for in
GUARD = 64.0 * 2.2e-16  # of ‖M‖‖X‖: several times what inverse and norms of a few rows lose
HUGE = 1e150  # of what has no inverse
FAR = 0.5  # relative: a gain that moves more over a box is bounded, not followed


@dataclass(frozen=True)
class ChannelFamily(LoopFamily):
    """As `LoopFamily`, of any number of channels and parameters; only |S| is enclosed.

    `parts`: structure and κ of each channel, `outputs` (p, p) and `inputs` (m, p) their directions.
    """

    parts: tuple[tuple[Structure, Array], ...]
    outputs: Array
    inputs: Array

    def enclose(self, boxes: Boxes) -> Enclosures:
        """Every bound on |S| on all boxes."""
        count = len(boxes.chart)
        x, y, _, turn = self._axis(boxes)
        U, V = self.outputs, self.inputs
        K, loose, faint = self._gains(x, y)
        loose = loose * np.linalg.cond(U)
        m, r, shares, damped = self._discs(boxes, x, y, turn)
        open_ = ~np.isfinite(m + r)  # modes that no disc is found for
        good = ~open_.any(axis=0) & np.isfinite(K).all(axis=1) & np.isfinite(y.rest)
        m, r, K = np.where(good, m, 0.0), np.where(good, r, 0.0), np.where(good[:, None], K, 0.0)
        c, b = self.plant.reading, self.plant.drive
        rows = np.einsum("im,mc,Nc,pc->iNp", b, V, K, U)
        sizes = np.linalg.norm(c, axis=1)[:, None], np.linalg.norm(rows, axis=2)
        weight = r * sizes[0] * sizes[1]
        at = np.arange(count)
        strong = np.argmax(weight, axis=0)
        one = np.ones(count)
        if not self._integrator:
            y0, moved, most, least = one, 0.0 * one, one, one
        else:
            y0, moved, most, least = y.centre, y.reach + y.rest, y.highest, y.lowest
        own = c[strong], rows[strong, at], m[strong, at], r[strong, at]
        others, rest = m.copy(), r.copy()
        others[strong, at], rest[strong, at] = 0.0, 0.0
        M = y0[:, None, None] * np.eye(len(U)) + np.einsum("iN,ip,iNq->Npq", others, c, rows)
        X = _inverses(M)
        u, v = np.einsum("Npq,Nq->Np", X, own[0]), np.einsum("Np,Npq->Nq", own[1], X)
        beta = np.einsum("Np,Np->N", own[1], u)
        a, reach = 1.0 + beta * own[2], np.abs(beta) * own[3]
        q = np.abs(a) ** 2 - reach**2
        good &= (q > 0.0) & (np.linalg.norm(X, axis=(1, 2)) < HUGE)
        q = np.where(good, q, 1.0)
        gamma, rho = (own[2] * a.conj() - beta.conj() * own[3] ** 2) / q, own[3] / q
        outer = u[:, :, None] * v[:, None, :]
        X, outer = (np.where(good[:, None, None], part, np.eye(len(U))) for part in (X, outer))
        gamma, rho = np.where(good, gamma, 0.0), np.where(good, rho, 0.0)
        places = np.concatenate([gamma[None], gamma + CORNERS[:, None] * rho])
        norms = np.linalg.norm(X - places[..., None, None] * outer, 2, axis=(-2, -1))
        lost = 1.0 + GUARD * np.linalg.norm(M, axis=(1, 2)) * np.linalg.norm(X, axis=(1, 2))
        share = (sizes[1] + 1e-30) / (sizes[0] + 1e-30)
        left = np.einsum("iN,ip,iq->Npq", rest * share, c, c)
        right = np.einsum("iN,iNp,iNq->Npq", rest / share, rows.conj(), rows)
        delta = np.sqrt(
            np.linalg.norm(left, 2, axis=(1, 2)) * np.linalg.norm(right, 2, axis=(1, 2))
        )
        faint_rows = np.linalg.norm(np.einsum("im,mc,Nc->iNc", np.abs(b), np.abs(V), faint), axis=2)
        size = (np.abs(m) + r) * sizes[0] * faint_rows * np.linalg.norm(U, 2)
        taken = (delta + moved + size.sum(0)) * lost
        sigma = (1.0 / (norms.max(axis=0) * lost) - taken) * (1.0 - loose) - most * loose
        spin = rho * np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1)
        other = (lost / np.maximum(norms[0] - spin, 1e-300) + taken) * (1.0 + loose) + most * loose
        bounded = damped & good & (sigma > 0.0) & (loose < 1.0) & np.isfinite(lost)
        over = 1.0 / np.where(bounded, sigma, 1.0)
        found = self._held(boxes, over, most, np.where(bounded, least / other, 0.0))
        weight = sizes[0] * sizes[1]
        felt = spin / norms[0] ** 2 / np.maximum(own[3], 1e-300)
        weight[strong, at] = np.where(good, felt, weight[strong, at])
        weight[open_] = 1.0
        spread = np.einsum("iN,ikN->kN", weight, np.where(np.isfinite(shares), shares, 0.0))
        spread[0] += moved + most * loose
        names, most_at, least_at = zip(*found, strict=True)
        highest = np.where(bounded, np.array(most_at), np.inf)
        return Enclosures(names, highest, np.array(least_at), spread, bounded)

    @property
    def _integrator(self) -> bool:
        return all(own.integrator for own, _ in self.parts)

    def _gains(self, x: Affine, y: Affine) -> tuple[np.ndarray, Array, Array]:
        """K̂ of every channel in the middle (N, c), and how far K̂ lies from it at most, relative
        (N,); where that is far, as at infinity, the middle is 0 and |K̂| is in the last (N, c)."""
        found, faint, loose = [], [], np.zeros(len(x.centre))
        for structure, kappa in self.parts:
            own = replace(self, structure=structure, kappa=kappa)
            above, below = own._controller(x, y)
            if structure.integrator and not self._integrator:
                below = below * y
            K = above * inverse(below)
            radius = K.reach + K.rest
            near = radius < FAR * np.abs(K.centre)
            found.append(np.where(near, K.centre, 0.0))
            faint.append(np.where(near, 0.0, np.abs(K.centre) + radius))
            loose = np.maximum(loose, np.where(near, radius / np.abs(K.centre), 0.0))
        return np.array(found).T, loose, np.array(faint).T

    def _discs(
        self, boxes: Boxes, x: Affine, y: Affine, turn: Affine
    ) -> tuple[np.ndarray, Array, Array, np.ndarray]:
        """m and r (n, N) of every mode, what each coordinate adds to r (n, 1 + n_p, N), and where
        all modes stay damped."""
        common = [i for i, name in enumerate(self.names) if not name.startswith("mode_shift")]
        shape = (len(self.plant.omega), len(boxes.chart))
        m, r, damped = np.zeros(shape, complex), np.zeros(shape), np.ones(shape[1], bool)
        shares = np.zeros((shape[0], 1 + len(self.names), shape[1]))
        flexible = 0
        for i in range(shape[0]):
            flexible += not self.plant.rigid[i]
            name, rows = f"mode_shift {flexible}", list(common)
            if not self.plant.rigid[i] and name in self.names:
                rows.append(self.names.index(name))
            named = tuple("mode_shift 1" if k not in common else self.names[k] for k in rows)
            poles, calm = self.plant.only(i).poles(named, boxes.low[1:][rows], boxes.high[1:][rows])
            damped &= calm
            (D, N), (E, M) = (self._factor(p, residue, x, y, turn) for p, residue in poles)
            # both as one form, since far above a resonance they nearly cancel, or a disc of each
            whole = N * inverse(D) + M * inverse(E)
            first, second = quotient(N, D), quotient(M, E)
            radius, apart = whole.reach + whole.rest, first[1] + second[1]
            near = ~(radius <= apart)
            m[i] = np.where(near, first[0] + second[0], whole.centre)
            r[i] = np.where(near, apart, radius) * (1.0 + 1e-12)
            moves = np.abs(first[0]) * first[2] + np.abs(second[0]) * second[2]
            shares[i, [0, *(1 + k for k in rows)]] = np.where(near, moves, np.abs(whole.slope))
        return m, r, shares, damped

    def _held(
        self, boxes: Boxes, over: Array, most: Array, somewhere: Array
    ) -> list[tuple[str, Array, Array]]:
        """(name, figure over its bound at most, the same at least) of every bound on |S|."""
        b, point = self.bounds, boxes.chart == Chart.POINT
        inside = np.where(point, np.inf, 1.0)
        low, high = self._omega(boxes)
        below = np.where(~point & (high <= self.bandwidth * (1.0 + 1e-12)), 1.0, np.inf)
        S = most * over
        limits = {
            "S_MAX": b.S_max * inside,
            "S_LOW": np.where(point, b.S_low, np.inf),
            "LEVEL": np.sqrt(0.5) * below,
        }
        found = [(name, S / limit, somewhere / limit) for name, limit in limits.items()]
        if b.shape is not None:
            until = below if self.shape_ends_early else inside
            until = np.where(low >= self.corner * (1.0 - 1e-12), np.inf, until)
            top = b.shape * np.sqrt(0.5) / self.bandwidth
            # |y| <= ω/unit, so that near 0 |S|/ω is bounded with an integrator
            rising = over / self.unit if self._integrator else S / np.maximum(low, b.omega_low)
            rising = np.minimum(rising, S / np.maximum(low, 1e-300))
            least = somewhere / np.maximum(high, b.omega_low)
            found.append(("SHAPE", rising / (top * until), least / (top * until)))
        return found


def _inverses(M: np.ndarray) -> np.ndarray:
    """M⁻¹ (N, p, p); `HUGE` where there is none."""
    none = np.linalg.det(M) == 0.0
    X = np.linalg.inv(np.where(none[:, None, None], np.eye(M.shape[1]), M))
    return np.asarray(np.where(none[:, None, None], HUGE, X))


def quotient(N: Affine, D: Affine) -> tuple[np.ndarray, Array, Array]:
    """Centre and radius of a disc around N/D, and how each variable moves it (n, N), relative.

    1/D lies in that of 1/D as a form, or where Re e^{-jθ}D >= d in the disc of diameter 1/d that
    touches 0; N then turns and scales the latter, which keeps 0 on its edge.
    """
    form = inverse(D)
    turned = TURNS.conj()[:, None] * D.centre
    d = turned.real - np.abs((TURNS.conj()[:, None, None] * D.slope).real).sum(1) - D.rest
    best = np.argmax(d, axis=0)
    d = d[best, np.arange(len(best))]
    half = np.where(d > 0.0, 0.5 / np.where(d > 0.0, d, 1.0), np.inf) * (1.0 + 1e-15)
    centre, radius = form.centre, form.reach + form.rest
    size = np.abs(N.centre)
    spread = N.reach + N.rest
    outer = size * radius + spread * (np.abs(centre) + radius)
    along = N.slope / np.where(size == 0.0, 1.0, N.centre)
    longer, aside = (np.abs(part).sum(0) + N.rest / size for part in (along.real, along.imag))
    grown = np.hypot(1.0 + longer, aside)
    bent = np.where(longer < 1.0, aside / np.where(longer < 1.0, 1.0 - longer, 1.0), np.inf)
    touching = size * half * grown * (1.0 + bent)
    chosen = ~(outer <= touching)
    edge = N.centre * TURNS[best].conj() * half * grown
    moves = np.abs(D.slope) / np.where(chosen, d, np.abs(D.centre)) + np.abs(along)
    return np.where(chosen, edge, N.centre * centre), np.where(chosen, touching, outer), moves
