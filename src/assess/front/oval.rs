//! Ovals that burn, and how likely each is before anything is seen.

use super::super::extent::Wind;
use nalgebra::{Rotation2, Vector2};

/// Directions of the head.
const HEADS: usize = 24;
/// Length over width of the oval, and how likely it is beforehand: fires before a wind of some m/s
/// are one and a half to two and a half times as long as wide.
const LENGTHS: [(f64, f64); 6] = [
    (1.1, 0.5),
    (1.25, 1.0),
    (1.5, 2.0),
    (2.0, 2.0),
    (2.7, 0.5),
    (3.5, 0.25),
];
/// Flanks against Alexander's, and how likely that is.
const FLANKS: [(f64, f64); 4] = [(0.7, 0.2), (1.0, 0.4), (1.4, 0.3), (2.0, 0.1)];
/// How likely a round fire is beforehand.
const ROUND: f64 = 2.0;

/// How far heads run off the wind, one sigma: slopes and gusts turn them, radians.
const DOWNWIND_RAD: f64 = 0.4;

/// How far an oval may lie from the middle of its cell, one sigma: direction in radians, logarithms of
/// length over width and of the flanks' share. About half of what lies between two cells, so that together
/// they leave no gap.
pub(super) const CELL: [f64; 3] = [0.13, 0.15, 0.18];

/// An oval whose head is 1 away from the place of ignition.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Oval {
    pub head: Vector2<f64>,
    pub back: f64,
    pub flank: f64,
}

/// The middle of a cell of ovals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Cell {
    head: Vector2<f64>,
    length: f64,
    flanks: f64,
}

impl Oval {
    pub(super) const ROUND: Self = Self {
        head: Vector2::new(0.0, 1.0),
        back: 1.0,
        flank: 1.0,
    };

    /// Alexander's, of a length over width, with flanks of a share of his.
    pub(super) fn of(head: Vector2<f64>, length: f64, flanks: f64) -> Self {
        let length = length.max(1.0);
        let root = (length * length - 1.0).sqrt();
        let back = (length - root) / (length + root);
        Self {
            head,
            back,
            flank: flanks * (1.0 + back) / 2.0 / length,
        }
    }

    /// Support function.
    pub(super) fn reach(&self, outwards: &Vector2<f64>) -> f64 {
        let (along, across) = (self.head.dot(outwards), self.head.perp(outwards));
        let half = (1.0 + self.back) / 2.0;
        (1.0 - self.back) / 2.0 * along + (half * along).hypot(self.flank * across)
    }

    /// A point of the rim and its outward direction.
    pub(super) fn rim(&self, angle: f64) -> (Vector2<f64>, Vector2<f64>) {
        let left = Vector2::new(-self.head.y, self.head.x);
        let (half, middle) = ((1.0 + self.back) / 2.0, (1.0 - self.back) / 2.0);
        let (sin, cos) = angle.sin_cos();
        let place = self.head * (middle + half * cos) + left * (self.flank * sin);
        let outwards = self.head * (self.flank * cos) + left * (half * sin);
        (place, outwards.normalize())
    }

    /// How much it points: 0 for a round fire, towards 1 for one that runs one way.
    pub(super) fn points(&self) -> f64 {
        (1.0 - self.back) / (1.0 + self.back)
    }

    /// Log of the prior: fires run before the wind, the surer the stronger it blows.
    pub(super) fn downwind(&self, wind: Option<&Wind>) -> f64 {
        let Some(wind) = wind else {
            return 0.0;
        };
        let speed = wind.towards_m_s.norm();
        if speed < 1e-6 {
            return 0.0;
        }
        let doubt = (wind.sigma_m_s / speed).hypot(DOWNWIND_RAD);
        let (along, across) = (
            self.head.dot(&wind.towards_m_s),
            self.head.perp(&wind.towards_m_s),
        );
        // A round fire has no head.
        -0.5 * (across.atan2(along) / doubt).powi(2) * (1.0 - self.back).max(0.0).sqrt()
    }
}

impl Cell {
    /// The oval that is turned (clockwise, radians), longer and wider (logarithms) than the middle one.
    pub(super) fn moved(&self, [turn, longer, wider]: [f64; 3]) -> Oval {
        Oval::of(
            Rotation2::new(-turn) * self.head,
            self.length * longer.exp(),
            self.flanks * wider.exp(),
        )
    }
}

/// All cells by the direction of their heads, each with how likely it is beforehand.
pub(super) fn cells() -> Vec<Vec<(Cell, f64)>> {
    let of_head = |k: usize| {
        let azimuth = std::f64::consts::TAU * k as f64 / HEADS as f64;
        let head = Vector2::new(azimuth.sin(), azimuth.cos());
        let forms = LENGTHS.iter().flat_map(|(length, likely)| {
            FLANKS.map(|(flanks, share)| (*length, flanks, likely * share))
        });
        forms
            .map(|(length, flanks, likely)| {
                let cell = Cell {
                    head,
                    length,
                    flanks,
                };
                (cell, likely)
            })
            .collect()
    };
    (0..HEADS).map(of_head).collect()
}

/// How likely a round fire is beforehand, against all cells.
pub(super) fn round_likely() -> f64 {
    ROUND * HEADS as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rim_lies_on_the_oval_and_the_head_reaches_farthest() {
        let oval = Oval::of(Vector2::x(), 1.5, 1.0);
        for k in 0..24 {
            let (rim, outwards) = oval.rim(f64::from(k) * 0.26);
            assert!((rim.dot(&outwards) - oval.reach(&outwards)).abs() < 1e-9);
            assert!(oval.reach(&outwards) <= 1.0 + 1e-9);
        }
        assert!((oval.reach(&Vector2::x()) - 1.0).abs() < 1e-9);
        assert!((oval.reach(&-Vector2::x()) - oval.back).abs() < 1e-9);
    }

    #[test]
    fn a_turn_is_clockwise_and_a_cell_reaches_to_its_neighbours() {
        let cells = cells();
        let (north, _) = cells[0][0];
        let turned = north.moved([std::f64::consts::FRAC_PI_2, 0.0, 0.0]);
        assert!((turned.head - Vector2::x()).norm() < 1e-12, "{turned:?}");
        let (next, _) = cells[1][0];
        let there = north.moved([std::f64::consts::TAU / 24.0, 0.0, 0.0]);
        assert!((there.head - next.moved([0.0; 3]).head).norm() < 1e-12);
    }
}
