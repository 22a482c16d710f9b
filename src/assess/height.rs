//! How high flames stand, from boxes that look down on them.
//!
//! A box from above is as high as the flames, plus what lies between the near edge and the tallest
//! tip, seen under the slope of the sight: part of the fire's depth, and the lean of the flames in
//! the wind. The depth is told; the lean is solved for with the height from looks from several sides,
//! or taken from the wind where that is known.

use super::extent::{Measured, Wind};
use super::outline::InMetres;
use nalgebra::{Matrix4, Vector2, Vector4};

/// Share of the depth that lies between the near edge and the tallest tip: of one flame, and what
/// that grows by when the fire is far deeper than its flames are high, and its far edge sticks out.
const TIP_AT: f64 = 0.35;
const TIP_FARTHER: f64 = 0.55;
/// One sigma of that share.
const TIP_SIGMA: f64 = 0.07;
/// Lean of a flame in the wind against its height: `LEAN u / sqrt(g h)`, at most [`MOST_LEAN`].
const LEAN: f64 = 0.3;
const MOST_LEAN: f64 = 1.2;
/// One sigma of the lean: as a share of it where the wind is known, of the height where it is not.
const LEAN_SIGMA: f64 = 0.5;
const UNKNOWN_LEAN: f64 = 0.35;
/// One sigma of the height's change in a second, as a share of it.
const CHANGE: f64 = 0.15;
/// Flicker of one look's height, as a share; the looks' own scatter replaces it.
const FLICKER: f64 = 0.15;
/// Times that height and tip are worked out from each other.
const SETTLING: usize = 8;
/// Height is never told below this share of the box's.
const LEAST_SHARE: f64 = 0.15;

/// Height of the flames at time 0, without what range and box may be wrong by. `None` for fewer than
/// four looks.
///
/// What depth and tip may be wrong by goes through the whole solution, to both sides: a low fire that is
/// deep and a high one that is not look alike from above, and a little more depth makes much less height.
#[must_use]
pub fn height(
    looks: &[(f64, InMetres)],
    depth: &Measured,
    wind: Option<&Wind>,
) -> Option<Measured> {
    let of = |depth_m: f64, tip_off: f64| both_ways(looks, depth_m, tip_off, wind);
    let told = of(depth.value, 0.0)?;
    let apart = |one: Option<Measured>, other: Option<Measured>| {
        let off = |height: Option<Measured>| height.map_or(0.0, |h| (h.value - told.value).abs());
        off(one).max(off(other))
    };
    let less_deep = (depth.value - depth.sigma).max(0.0);
    let by_depth = apart(of(depth.value + depth.sigma, 0.0), of(less_deep, 0.0));
    let by_tip = apart(of(depth.value, TIP_SIGMA), of(depth.value, -TIP_SIGMA));
    Some(Measured {
        sigma: told.sigma.hypot(by_depth).hypot(by_tip),
        ..told
    })
}

/// Height for one depth, and a share of it by which the tip stands farther than assumed. Where a low
/// fire whose tip is far and a high one whose tip is near both fit, it is in between.
fn both_ways(
    looks: &[(f64, InMetres)],
    depth_m: f64,
    tip_off: f64,
    wind: Option<&Wind>,
) -> Option<Measured> {
    let low = settled(looks, depth_m, tip_off, TIP_AT + TIP_FARTHER, wind)?;
    let high = settled(looks, depth_m, tip_off, TIP_AT, wind)?;
    Some(Measured {
        value: (low.value + high.value) / 2.0,
        sigma: low
            .sigma
            .max(high.sigma)
            .hypot((high.value - low.value) / 2.0),
    })
}

/// Height from a first share of the depth at which the tip stands.
fn settled(
    looks: &[(f64, InMetres)],
    depth_m: f64,
    tip_off: f64,
    mut tip_share: f64,
    wind: Option<&Wind>,
) -> Option<Measured> {
    // How far the tallest tip stands from the near edge depends on the height itself.
    let mut height = None;
    for _ in 0..SETTLING {
        let told = solve(looks, (tip_share + tip_off) * depth_m, wind)?;
        let flatness = depth_m / (depth_m + told.value);
        tip_share = TIP_AT + TIP_FARTHER * flatness * flatness;
        height = Some(told);
    }
    height
}

/// Unknowns: height now, its change per second, lean towards east and north. The tip stands `tip_m`
/// behind the near edge.
fn solve(looks: &[(f64, InMetres)], tip_m: f64, wind: Option<&Wind>) -> Option<Measured> {
    if looks.len() < 4 {
        return None;
    }
    let raised = |look: &InMetres| look.apparent_height_m - tip_m * look.slope;
    let apparent = median(looks.iter().map(|(_, look)| look.apparent_height_m));
    let least = (LEAST_SHARE * apparent).max(0.02);
    let guess = median(looks.iter().map(|(_, look)| raised(look))).max(least);
    let (lean, lean_sigma) = lean(guess, wind);
    let before = Vector4::new(guess, 0.0, lean.x, lean.y);
    let sigmas = Vector4::new(1e3 * guess, CHANGE * guess, lean_sigma, lean_sigma);
    let prior = Matrix4::from_diagonal(&sigmas.map(|sigma| sigma.powi(-2)));
    let by = |t_s: f64, look: &InMetres| {
        Vector4::new(
            1.0,
            t_s,
            look.slope * look.sight.x,
            look.slope * look.sight.y,
        )
    };
    let last = looks.last()?.1;
    let mut noise = FLICKER * guess + 0.002 * last.range_m;
    let mut variance = 0.0;
    let mut solved = before;
    for _ in 0..2 {
        let weight = noise.powi(-2);
        let (mut information, mut right) = (prior, prior * before);
        for (t_s, look) in looks {
            let by = by(*t_s, look);
            information += by * by.transpose() * weight;
            right += by * (raised(look) * weight);
        }
        let cholesky = information.cholesky()?;
        solved = cholesky.solve(&right);
        variance = cholesky.inverse()[(0, 0)];
        let left = looks
            .iter()
            .map(|(t_s, look)| raised(look) - by(*t_s, look).dot(&solved));
        noise = scatter(&left.collect::<Vec<f64>>()) + 1e-3;
    }
    let value = solved[0].max(least);
    Some(Measured {
        value,
        // What had to be put right was told wrong.
        sigma: variance.max(0.0).sqrt().hypot(value - solved[0]),
    })
}

/// Lean of a flame of a height, metres east and north, and one sigma per axis.
fn lean(height_m: f64, wind: Option<&Wind>) -> (Vector2<f64>, f64) {
    let Some(wind) = wind.filter(|wind| wind.towards_m_s.norm() > 1e-6) else {
        return (Vector2::zeros(), UNKNOWN_LEAN * height_m);
    };
    let speed = wind.towards_m_s.norm();
    let share = (LEAN * speed / (9.81 * height_m).sqrt()).min(MOST_LEAN);
    let lean = wind.towards_m_s * (share * height_m / speed);
    (lean, LEAN_SIGMA * lean.norm() + 0.05 * height_m)
}

/// Root of the mean square, widened for neighbours that are alike.
fn scatter(left: &[f64]) -> f64 {
    let power: f64 = left.iter().map(|r| r * r).sum();
    let lagged: f64 = left.windows(2).map(|pair| pair[0] * pair[1]).sum();
    let alike = (lagged / power.max(1e-12)).clamp(0.0, 0.9);
    let freedom = (left.len() as f64 - 3.0).max(1.0);
    (power / freedom * (1.0 + alike) / (1.0 - alike)).sqrt()
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Boxes of a flame 2 m high and 1 m deep that leans 0.6 m to the east, from all around.
    fn boxes() -> Vec<(f64, InMetres)> {
        let at = |k: u32| {
            let angle = f64::from(k) * 0.3;
            let sight = Vector2::new(angle.sin(), angle.cos());
            let slope = 0.5;
            let behind = 0.45 * 1.0 + 0.6 * sight.x;
            let look = InMetres {
                width_m: 1.0,
                apparent_height_m: 2.0 + slope * behind,
                slope,
                sight,
                range_m: 20.0,
                flat_m: 18.0,
            };
            (f64::from(k) * 0.5 - 10.0, look)
        };
        (0..20).map(at).collect()
    }

    #[test]
    fn depth_and_lean_are_not_taken_for_height() {
        let depth = Measured {
            value: 1.0,
            sigma: 0.2,
        };
        let told = height(&boxes(), &depth, None).unwrap();
        assert!((told.value - 2.0).abs() < 0.1, "{told:?}");
        assert!((0.02..0.4).contains(&told.sigma), "{told:?}");
    }

    #[test]
    fn a_depth_that_is_not_known_makes_a_height_that_is_not() {
        // A running front from one side: 0.9 m high, 6 m deep, taken for as deep as it is wide.
        let behind = (TIP_AT + TIP_FARTHER * 0.76) * 6.0;
        let looks: Vec<(f64, InMetres)> = boxes()
            .into_iter()
            .map(|(t_s, look)| {
                let look = InMetres {
                    apparent_height_m: 0.9 + behind,
                    slope: 1.0,
                    sight: Vector2::y(),
                    ..look
                };
                (t_s, look)
            })
            .collect();
        let depth = Measured {
            value: 3.6,
            sigma: 1.4,
        };
        let told = height(&looks, &depth, None).unwrap();
        assert!(told.sigma > 0.3 * told.value, "{told:?}");
        assert!((told.value - 0.9).abs() < 2.5 * told.sigma, "{told:?}");
    }

    #[test]
    fn an_unknown_lean_seen_from_one_side_widens_the_error() {
        let depth = Measured {
            value: 1.0,
            sigma: 0.2,
        };
        let one_side: Vec<(f64, InMetres)> = boxes()
            .into_iter()
            .map(|(t_s, look)| {
                (
                    t_s,
                    InMetres {
                        sight: Vector2::x(),
                        ..look
                    },
                )
            })
            .collect();
        let wide = height(&one_side, &depth, None).unwrap();
        let around = height(&boxes(), &depth, None).unwrap();
        assert!(wide.sigma > 1.5 * around.sigma, "{wide:?} {around:?}");
    }
}
