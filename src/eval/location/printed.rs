//! P3's method as printed, on the same sightings: each look's own position, averaged.
//!
//! Lu et al., Forests 2022, 13, 383. Corrected, or it would give no place at all: disparity is
//! left minus right (E1), longitude by atan2 and e² (E4), the 4x4 matrix with the vehicle's place (E5).
//! Kept: the centre of the box at the mean disparity, attitude and place as reported at the stamp, no
//! lever arm, no weights, looks without a disparity write no value. E3 (zeros of the disparity map
//! counted into the mean) is applied on wish.

use super::truth::{IMAGE_PX, Lens, Reported, Seen};
use nalgebra::Vector3;

/// Share of a box's pixels at which a block matcher finds nothing, as P3 averages them in.
pub const INVALID_SHARE: f64 = 0.1;

/// Mean position over the looks, metres; `None` when no look had a disparity.
#[must_use]
pub fn printed(
    lens: &Lens,
    looks: &[(Reported, Seen)],
    zeros_counted: bool,
) -> Option<Vector3<f64>> {
    let places: Vec<_> = looks
        .iter()
        .filter_map(|(reported, seen)| one_look(lens, reported, seen, zeros_counted))
        .collect();
    (!places.is_empty()).then(|| places.iter().sum::<Vector3<f64>>() / places.len() as f64)
}

/// Position by one look (equations 6 to 14).
#[must_use]
pub fn one_look(
    lens: &Lens,
    reported: &Reported,
    seen: &Seen,
    zeros_counted: bool,
) -> Option<Vector3<f64>> {
    let kept = if zeros_counted {
        1.0 - INVALID_SHARE
    } else {
        1.0
    };
    let disparity = seen.disparity_px.filter(|d| *d > 0.0)? * kept;
    let z = lens.focal_px * lens.baseline_m / disparity;
    let x = z * (seen.centroid_px.0 - 0.5 * IMAGE_PX.0) / lens.focal_px;
    let y = z * (seen.centroid_px.1 - 0.5 * IMAGE_PX.1) / lens.focal_px;
    let (sin, cos) = lens.depression_deg.to_radians().sin_cos();
    let body = Vector3::new(z * cos - y * sin, x, z * sin + y * cos);
    Some(reported.position_m + reported.enu_from_body * body)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix3;

    fn level_to_the_north() -> Reported {
        #[rustfmt::skip]
        let enu_from_body = Matrix3::new(
            0.0, 1.0, 0.0,
            1.0, 0.0, 0.0,
            0.0, 0.0, -1.0,
        );
        Reported {
            t_s: 0.0,
            position_m: Vector3::zeros(),
            enu_from_body,
            velocity_m_s: Vector3::zeros(),
            rate_rad_s: Vector3::zeros(),
        }
    }

    fn ten_metres_ahead(lens: &Lens) -> Seen {
        Seen {
            base_px: (640.0, 370.0),
            size_px: (20.0, 20.0),
            disparity_px: Some(lens.focal_px * lens.baseline_m / 10.0),
            centroid_px: (640.0, 360.0),
            glow: 1.0,
        }
    }

    /// Checklist item 48; and E3: one pixel in ten without a match puts the fire 11 % further away.
    #[test]
    fn the_printed_chain_keeps_its_own_vector_and_its_zeros_push_the_fire_away() {
        let (lens, reported) = (Lens::short(), level_to_the_north());
        let seen = ten_metres_ahead(&lens);
        let right = one_look(&lens, &reported, &seen, false).unwrap();
        assert!((right - Vector3::new(0.0, 8.660_254, -5.0)).norm() < 1e-6);
        let wrong = one_look(&lens, &reported, &seen, true).unwrap();
        assert!((wrong.norm() / right.norm() - 1.0 / 0.9).abs() < 1e-9);
    }
}
