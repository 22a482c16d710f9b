//! The way that was flown, summed up from reported velocities, and what the reported positions stray
//! from it.
//!
//! A receiver's position wanders by metres while its velocity, from the Doppler shift, is right to
//! centimetres a second. Over seconds the velocity says better how far the camera moved; over minutes
//! the position does. So each frame's reported position less the way so far is kept: between two
//! frames it changes as the receiver's error does, with a variance that grows with the way's time.

use crate::locate::View;
use emberfix_frames::{ServiceTime, Vector3};

/// What reported positions stray from the way so far.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    /// When.
    pub at: ServiceTime,
    /// Reported position less the way since some moment: east, north, up, metres. Means something only
    /// against another reading.
    pub strayed_m: Vector3<f64>,
    /// Of the way since that moment, per axis, m².
    pub variance_m2: f64,
}

/// The way so far.
#[derive(Debug, Clone, Copy)]
pub struct Odometer {
    reading: Reading,
    position_m: Vector3<f64>,
    velocity_m_s: Vector3<f64>,
}

/// What of a reported way was flown.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Flown {
    /// By how much the receiver's error changed on it, metres.
    pub strayed_m: Vector3<f64>,
    /// Share of the rest that was surely flown.
    pub share: f64,
}

/// How fast an airframe's acceleration changes in gusts, m/s³: the mean of two velocities is off by
/// a twelfth of it times the cube of the time between them.
const JERK_M_S3: f64 = 1.0;

impl Odometer {
    /// Set to zero.
    #[must_use]
    pub fn new(view: &View<'_>) -> Self {
        let position_m = view.body_enu();
        Self {
            reading: Reading {
                at: view.pose.at,
                strayed_m: position_m,
                variance_m2: 0.0,
            },
            position_m,
            velocity_m_s: view.pose.velocity_enu_m_s,
        }
    }

    /// As of the latest frame.
    #[must_use]
    pub fn reading(&self) -> Reading {
        self.reading
    }

    /// Goes on to another frame. From one that is not later nothing is learned.
    pub fn go_on(&mut self, view: &View<'_>) -> Reading {
        let dt_s = (view.pose.at - self.reading.at).as_secs_f64();
        let (position_m, velocity_m_s) = (view.body_enu(), view.pose.velocity_enu_m_s);
        if dt_s > 0.0 {
            let way = (self.velocity_m_s + velocity_m_s) * (0.5 * dt_s);
            let bend_m = JERK_M_S3 * dt_s.powi(3) / 12.0;
            self.reading = Reading {
                at: view.pose.at,
                strayed_m: self.reading.strayed_m + position_m - self.position_m - way,
                variance_m2: self.reading.variance_m2
                    + view.priors().way_variance_m2_per_s() * dt_s
                    + bend_m * bend_m,
            };
            (self.position_m, self.velocity_m_s) = (position_m, velocity_m_s);
        }
        self.reading
    }
}

impl Reading {
    /// By how much the receiver's error has most likely changed since an earlier reading, metres, and the
    /// variances of that, when it would by itself have changed with the variances `by_itself` (m²).
    #[must_use]
    pub fn strayed_since(
        &self,
        earlier: &Self,
        by_itself: &Vector3<f64>,
    ) -> (Vector3<f64>, Vector3<f64>) {
        let variance = self.variance_m2 - earlier.variance_m2;
        let share = by_itself.map(|own| own / (own + variance).max(f64::MIN_POSITIVE));
        let strayed_m = share.component_mul(&(self.strayed_m - earlier.strayed_m));
        (strayed_m, share * variance)
    }
}

impl Flown {
    /// Of the way as reported.
    #[must_use]
    pub fn of(&self, reported: &Vector3<f64>) -> Vector3<f64> {
        (reported - self.strayed_m) * self.share
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::locate::SharedPriors;
    use crate::testing::{datum, pose, rig};
    use emberfix_frames::{Coordinate, Metres, VehicleEnu, ecef_from_enu, seconds};

    /// Reported 3 m to the east and 1 m up of where a flight at a steady speed has come after a second,
    /// at ten frames.
    fn drifted() -> (Reading, Reading) {
        let (rig, datum, priors) = (rig(30.0), datum(), SharedPriors::default());
        let mut odometer: Option<Odometer> = None;
        let mut first = None;
        for frame in 0..=10 {
            let t_s = 0.1 * f64::from(frame);
            let mut pose = pose(0.0, 0.0, 0.0);
            let moved = pose.velocity_enu_m_s * t_s + Vector3::new(3.0, 0.0, 1.0) * t_s;
            pose.at = pose.at + seconds(t_s);
            pose.place = ecef_from_enu(&datum)
                .transform(Coordinate::<VehicleEnu>::from_metres(moved))
                .to_wgs84();
            let view = View::new(&rig, &pose, &priors, &datum);
            let reading = odometer
                .get_or_insert_with(|| Odometer::new(&view))
                .go_on(&view);
            first = first.or(Some(reading));
        }
        (first.unwrap(), odometer.unwrap().reading())
    }

    #[test]
    fn what_no_velocity_explains_the_receiver_has_strayed() {
        let (first, last) = drifted();
        let off = last.strayed_m - first.strayed_m - Vector3::new(3.0, 0.0, 1.0);
        assert!(off.norm() < 1e-6, "{off}");
        // 0.1 m/s that last a second, for a second; the bend within a tenth of one is nothing.
        assert!(
            (last.variance_m2 - 0.02).abs() < 1e-6,
            "{}",
            last.variance_m2
        );
    }

    #[test]
    fn a_receiver_that_wanders_less_than_the_way_errs_is_believed() {
        let (first, last) = drifted();
        let (strayed_m, variances) = last.strayed_since(&first, &Vector3::repeat(1e-6));
        assert!(strayed_m.norm() < 1e-3 && variances.amax() < 1e-6);
        let (strayed_m, variances) = last.strayed_since(&first, &Vector3::repeat(1e3));
        assert!((strayed_m - Vector3::new(3.0, 0.0, 1.0)).norm() < 1e-3);
        assert!((variances.x - 0.02).abs() < 1e-5);
    }
}
