//! A sighting as a linearised measurement of one fire: bearing and disparity.

use super::chart::{ByState, Chart, OF_FIRE, State};
use super::joint::{JOINT, JointVector, LASTING, Measured};
use super::odometer::Flown;
use crate::locate::{Distant, Lens, Linear, SHARED, Sighting, range_beneath};
use emberfix_calib::RectifiedPixel;
use emberfix_frames::{Matrix3, Vector3};
use nalgebra::{SMatrix, SVector};

/// What measures one fire in one frame.
#[derive(Clone, Copy)]
pub struct Look<'a> {
    /// The sighting.
    pub sighting: &'a Sighting,
    /// The camera, as far as it is known.
    pub lens: &'a Lens,
    /// Local vertical.
    pub up: &'a Vector3<f64>,
    /// What of the reported way since the first sighting was surely flown.
    pub flown: &'a Flown,
}

/// Row of the disparity.
const DISPARITY: usize = 2;
/// Errors that are new in each frame.
const NEW: usize = SHARED - LASTING;

impl Look<'_> {
    /// Linearised where the fire is at `at` and the errors are those that the lens was made with.
    #[must_use]
    pub fn measure(&self, chart: &Chart, at: &JointVector) -> Option<Measured> {
        let state: State = at.fixed_rows::<OF_FIRE>(0).into_owned();
        let (base, _, _) = chart.distant(&state);
        let seen = self.lens.linear(&base)?;
        let mut residual = Vector3::new(
            self.sighting.base.u - seen.value.x,
            self.sighting.base.v - seen.value.y,
            0.0,
        );
        let mut by_shared = seen.by_shared;
        let way = self.flown.of(&chart.way(self.lens, &shared(at)));
        let mut by_state = chart.slopes(&seen, &state, self.lens, &way);
        let flame = self.flame(&base);
        if let Some((px, linear)) = &flame {
            let slopes = chart.slopes(linear, &state, self.lens, &way);
            residual[DISPARITY] = px - linear.value[DISPARITY];
            by_state.set_row(DISPARITY, &slopes.row(DISPARITY));
            by_shared.set_row(DISPARITY, &linear.by_shared.row(DISPARITY));
        } else {
            by_state.row_mut(DISPARITY).fill(0.0);
            by_shared.row_mut(DISPARITY).fill(0.0);
        }
        Some(Measured {
            residual,
            rows: rows(&by_state, &by_shared),
            noise: self.pixels() + new_in_frame(&by_shared),
            has_disparity: flame.is_some(),
        })
    }

    fn pixels(&self) -> Matrix3<f64> {
        let (u, v) = self.sighting.base_sigma_px;
        let d = self.sighting.disparity.map_or(1.0, |d| d.sigma_px);
        Matrix3::from_diagonal(&Vector3::new(u * u, v * v, d * d))
    }

    /// Disparity of the flame, which was measured above the base: by how much, the pixels say.
    fn flame(&self, base: &Distant) -> Option<(f64, Linear)> {
        let measured = self.sighting.disparity?;
        let flame = flame_above(base, measured.centroid, self.lens, self.up)?;
        Some((measured.px, self.lens.linear(&flame)?))
    }
}

/// The point above a base that shows at the flame's pixel; `None` where none above it could.
#[must_use]
pub fn flame_above(
    base: &Distant,
    pixel: RectifiedPixel,
    lens: &Lens,
    up: &Vector3<f64>,
) -> Option<Distant> {
    let ray = lens.ray_enu(pixel);
    let sight = base.at - lens.centre() * base.over;
    let range = range_beneath(&sight, &ray, up)?;
    let height = (ray * range - sight).dot(up);
    Some(Distant {
        at: base.at + up * height,
        over: base.over,
    })
}

/// Over the fire and the errors that last.
#[must_use]
pub fn rows(by_state: &ByState, by_shared: &SMatrix<f64, 3, SHARED>) -> SMatrix<f64, 3, JOINT> {
    let mut rows = SMatrix::<f64, 3, JOINT>::zeros();
    rows.fixed_columns_mut::<OF_FIRE>(0).copy_from(by_state);
    rows.fixed_columns_mut::<LASTING>(OF_FIRE)
        .copy_from(&by_shared.fixed_columns::<LASTING>(0));
    rows
}

/// Covariance of what errors that are new in each frame do to column, row, disparity.
#[must_use]
pub fn new_in_frame(by_shared: &SMatrix<f64, 3, SHARED>) -> Matrix3<f64> {
    let by_new = by_shared.fixed_columns::<NEW>(LASTING);
    by_new * by_new.transpose()
}

/// The shared errors of a point, those that are new in each frame being nothing.
#[must_use]
pub fn shared(point: &JointVector) -> SVector<f64, SHARED> {
    let mut all = SVector::<f64, SHARED>::zeros();
    all.fixed_rows_mut::<LASTING>(0)
        .copy_from(&point.fixed_rows::<LASTING>(OF_FIRE));
    all
}
