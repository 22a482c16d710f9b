//! What is known of the errors that all fires share, in SI units.

use super::joint::{Known, LASTING};
use crate::locate::{SHARED, Shared, View};
use emberfix_frames::{Vector3, rotation_matrix};
use nalgebra::SVector;

/// One number with what is known of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimated {
    /// Best guess; what was reported less what is true.
    pub value: f64,
    /// One sigma of it.
    pub sigma: f64,
    /// One sigma before anything was seen.
    pub prior_sigma: f64,
}

/// The shared errors at the moment of the latest frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SharedErrors {
    /// GNSS offset: east, north, up; metres.
    pub gnss_m: [Estimated; 3],
    /// Heading of the autopilot, clockwise, radians.
    pub heading_rad: Estimated,
    /// Boresight against the airframe about the body's forward, right, down axes, radians. Hardly
    /// separable from heading and tilt: `pointing_rad` is what sightings tell.
    pub boresight_rad: [Estimated; 3],
    /// All that turns the camera against the reported attitude (boresight, tilt, heading), about the
    /// body's forward, right, down axes, radians.
    pub pointing_rad: [Estimated; 3],
    /// The reported pose is that of this much later than the exposure, seconds.
    pub clock_s: Estimated,
    /// Disparity offset, pixels.
    pub disparity_px: Estimated,
    /// Lever arm: forward, right, down; metres.
    pub lever_arm_m: [Estimated; 3],
}

/// Sigma over prior sigma below which an error counts as found.
const FOUND: f64 = 0.5;

impl Estimated {
    /// True when the sightings have said more of it than was known before.
    #[must_use]
    pub fn is_found(&self) -> bool {
        self.sigma < FOUND * self.prior_sigma
    }
}

impl SharedErrors {
    /// As the tracker knows them after a frame.
    #[must_use]
    pub fn read_off(known: &Known, view: &View<'_>) -> Self {
        let along = |weights: &[(usize, f64)]| {
            let mut by = SVector::<f64, SHARED>::zeros();
            for (index, weight) in weights {
                by[*index] = weight * view.sigmas()[*index];
            }
            estimated(&by, known)
        };
        let one = |index: usize| along(&[(index, 1.0)]);
        let three = |from: Shared| std::array::from_fn(|axis| one(from as usize + axis));
        let both = |a: usize, b: usize| along(&[(a, 1.0), (b, 1.0)]);
        let (constant, heading) = (Shared::HeadingConstant as usize, Shared::Heading as usize);
        let down = body_components(&-view.up(), view);
        let pointing = |axis: usize| {
            let mut weights = vec![(Shared::Boresight as usize + axis, 1.0)];
            if axis < 2 {
                weights.push((Shared::Tilt as usize + axis, 1.0));
            }
            weights.extend([(constant, down[axis]), (heading, down[axis])]);
            along(&weights)
        };
        Self {
            gnss_m: std::array::from_fn(|axis| {
                both(
                    Shared::GnssConstant as usize + axis,
                    Shared::Gnss as usize + axis,
                )
            }),
            heading_rad: both(constant, heading),
            boresight_rad: three(Shared::Boresight),
            pointing_rad: std::array::from_fn(pointing),
            clock_s: one(Shared::Clock as usize),
            disparity_px: one(Shared::Disparity as usize),
            lever_arm_m: three(Shared::LeverArm),
        }
    }
}

fn estimated(by: &SVector<f64, SHARED>, known: &Known) -> Estimated {
    let lasting = by.fixed_rows::<LASTING>(0);
    Estimated {
        value: lasting.dot(&known.mean),
        sigma: (lasting.transpose() * known.covariance * lasting)[0]
            .max(0.0)
            .sqrt(),
        prior_sigma: by.norm(),
    }
}

/// Components about the body's axes.
fn body_components(vector: &Vector3<f64>, view: &View<'_>) -> Vector3<f64> {
    let body_from_cam = rotation_matrix(&view.rig.body_from_cam_left());
    body_from_cam * (view.enu_from_cam.transpose() * vector)
}
