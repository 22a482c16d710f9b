//! A camera that points 3 degrees off and a clock that is 300 ms late, to be found from fires alone.
//!
//! In gusts the orbit leads around [`FIRES`] fires that lie by chance within [`WITHIN_M`] of its centre, as
//! orbits do: a single fire in the very centre is always seen under one depression, so that its height
//! and the camera's pitch can't be told apart by anybody, but for what stereo adds. In steady air one
//! fire stands in the centre: there the clock can't be told from the fire's place.

use super::estimator::{Pilot, SetupError};
use super::flight::{Course, Gusts, Kind};
use super::law::{Draw, Law};
use super::score::{CHI2_2_90, mean, score};
use super::truth::{
    Autopilot, ErrorModel, Flame, Gnss, Lens, Seen, Slow, TrueCamera, slow, wander,
};
use emberfix_sim::noise::stream;
use nalgebra::{Rotation3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, UnitDisc, UnitSphere};
use serde::Serialize;

/// Injected: boresight, degrees about an axis by chance; clock, seconds late or early.
pub const BORESIGHT_DEG: f64 = 3.0;
/// See [`BORESIGHT_DEG`].
pub const CLOCK_S: f64 = 0.3;

/// Fires in a gusty orbit.
pub const FIRES: usize = 3;
/// They lie, evenly by area, this near to its centre, metres.
pub const WITHIN_M: f64 = 40.0;

/// One orbit with a bent mount.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct MountFlown {
    /// What is left of the camera's line of sight, degrees: estimated pointing minus the true one,
    /// across the line of sight.
    pub pointing_error_deg: f64,
    /// The estimator's own sigma of that.
    pub pointing_sigma_deg: f64,
    /// The same for the mount's share alone (boresight), about the body axes.
    pub boresight_error_deg: f64,
    /// Estimated clock minus the true one, milliseconds.
    pub clock_error_ms: f64,
    /// The estimator's own sigma of it, milliseconds.
    pub clock_sigma_ms: f64,
    /// Looks with an alarm before half of the orbit, and how many of their ellipses held the truth.
    pub early: (u32, u32),
    /// Whether the last ellipse held the truth.
    pub held: bool,
    /// Horizontal error in the end, metres.
    pub error_m: f64,
}

/// How an orbit is flown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Air {
    /// Gusts of 3 degrees; boresight and clock are off.
    Gusty(Gnss),
    /// A perfect circle about the fire; only the clock is off.
    Steady,
}

impl Air {
    /// With RTK goes a heading of 0.5 degrees (two antennas); with a consumer receiver a compass of
    /// 1 degree. A receiver that wanders by a metre turns the bearing at 80 m by as much as a degree:
    /// what it leaves of the camera's direction nobody can find from a fire.
    fn errors(self) -> ErrorModel {
        let (gnss, heading_deg, boresight_deg) = match self {
            Self::Gusty(Gnss::Rtk) => (Gnss::Rtk, 0.5, BORESIGHT_DEG),
            Self::Gusty(Gnss::Consumer) => (Gnss::Consumer, 1.0, BORESIGHT_DEG),
            Self::Steady => (Gnss::Consumer, 1.0, 0.3),
        };
        ErrorModel {
            boresight_deg,
            clock_s: CLOCK_S,
            ..ErrorModel::of(gnss, heading_deg)
        }
    }
}

/// One orbit (80 m out, 60 m up, 9 m/s, 3 looks per second).
///
/// # Errors
/// [`SetupError`] when the rig is refused.
pub fn fly(rng: &mut ChaCha8Rng, air: Air) -> Result<Option<MountFlown>, SetupError> {
    let (errors, gusty) = (air.errors(), air != Air::Steady);
    let course = Course {
        kind: Kind::Orbit,
        ground_range_m: 80.0,
        height_m: 60.0,
        speed_m_s: 9.0,
        azimuth_rad: rng.random_range(0.0..std::f64::consts::TAU),
        duration_s: std::f64::consts::TAU * 80.0 / 9.0,
        gusts: if gusty {
            Gusts::new(rng, 3.0, 0.5)
        } else {
            Gusts::calm()
        },
    };
    let lens = Lens {
        depression_deg: course.mean_depression_deg(),
        ..Lens::wide()
    };
    let times_s = course.looks(200, 0.33);
    let mut wandered = wander(rng, &errors, &times_s, Law::Assumed);
    inject(rng, &mut wandered, gusty);
    let flames = flames(rng, gusty);
    let mut draws: Vec<Draw> = (0..flames.len())
        .map(|_| Draw::new(stream(rng.random(), "looks"), Law::Assumed))
        .collect();
    let mut pilot = Pilot::new(&lens, &errors, None)?;
    let (mut early, mut last, mut id) = ((0, 0), None, None);
    for (index, (t_s, slow)) in times_s.iter().zip(&wandered).enumerate() {
        let state = course.state(*t_s);
        let camera = TrueCamera {
            lens: &lens,
            state: &state,
            slow,
        };
        let sights = flames.iter().zip(&mut draws);
        let sights: Vec<_> = sights
            .map(|(flame, draw)| camera.see(flame, &errors, draw))
            .collect();
        let seen: Vec<Seen> = sights.iter().flatten().copied().collect();
        let autopilot = Autopilot::new(&course, *t_s, slow, &errors, rng);
        let given = pilot.look(&autopilot, &seen);
        if sights[0].is_some() {
            id = given[0].or(id);
        }
        let told = pilot.fires().into_iter();
        let told = told
            .filter(|fire| fire.confirmed)
            .find(|fire| Some(fire.id) == id);
        last = told.and_then(|fire| {
            let error = fire.position_m - flames[0].base_m;
            score(&error, &fire.covariance_m2, fire.ce90_m)
        });
        if let Some(scored) = last.filter(|_| index < times_s.len() / 2) {
            early = (early.0 + 1, early.1 + u32::from(scored.nees <= CHI2_2_90));
        }
    }
    let (Some(last), Some(truth), Some(end), Some(learned)) =
        (last, wandered.last(), times_s.last(), pilot.learned())
    else {
        return Ok(None);
    };
    let state = course.state(*end);
    let pointing = learned.pointing_rad - pointing(truth, &state.enu_from_body);
    let sight = (state.enu_from_body.transpose() * -state.position_m).normalize();
    let boresight: Vector3<f64> = truth.fixed_rows::<3>(slow::BORESIGHT).into_owned();
    Ok(Some(MountFlown {
        pointing_error_deg: pointing.cross(&sight).norm().to_degrees(),
        pointing_sigma_deg: across(&learned.pointing_sigma_rad, &sight).to_degrees(),
        boresight_error_deg: (learned.boresight_rad - boresight).norm().to_degrees(),
        clock_error_ms: 1e3 * (learned.clock_s - truth[slow::CLOCK]),
        clock_sigma_ms: 1e3 * learned.clock_sigma_s,
        early,
        held: last.nees <= CHI2_2_90,
        error_m: last.error_m,
    }))
}

fn flames(rng: &mut ChaCha8Rng, gusty: bool) -> Vec<Flame> {
    let flame = |base_m: Vector3<f64>| Flame {
        base_m,
        size_m: 2.0,
    };
    if !gusty {
        return vec![flame(Vector3::zeros())];
    }
    let mut one = || {
        let [east, north]: [f64; 2] = UnitDisc.sample(rng);
        flame(Vector3::new(east, north, 0.0) * WITHIN_M)
    };
    (0..FIRES).map(|_| one()).collect()
}

fn inject(rng: &mut ChaCha8Rng, wandered: &mut [Slow], gusty: bool) {
    let axis: [f64; 3] = UnitSphere.sample(rng);
    let boresight = Vector3::from(axis) * BORESIGHT_DEG.to_radians();
    let clock = CLOCK_S * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    for slow in wandered {
        slow[slow::CLOCK] = clock;
        if gusty {
            slow.fixed_rows_mut::<3>(slow::BORESIGHT)
                .copy_from(&boresight);
        }
    }
}

/// Sigma across a line of sight of turns about three axes, taken as independent.
fn across(sigmas: &Vector3<f64>, sight: &Vector3<f64>) -> f64 {
    let part = |axis: usize| sigmas[axis].powi(2) * (1.0 - sight[axis].powi(2));
    (0..3).map(part).sum::<f64>().sqrt()
}

/// All that turns the camera against the reported attitude, about body axes.
fn pointing(slow: &Slow, enu_from_body: &nalgebra::Matrix3<f64>) -> Vector3<f64> {
    let boresight: Vector3<f64> = slow.fixed_rows::<3>(slow::BORESIGHT).into_owned();
    let tilt = Vector3::new(slow[slow::TILT], slow[slow::TILT + 1], 0.0);
    // Clockwise about down.
    let down = enu_from_body.transpose() * -Vector3::z();
    let heading = Rotation3::from_scaled_axis(down * slow[slow::HEADING]).scaled_axis();
    boresight + tilt + heading
}

/// Many of them together.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct MountSummary {
    /// Flights.
    pub flights: usize,
    /// Root mean square of the pointing error, degrees.
    pub pointing_rms_deg: f64,
    /// Root mean square of the estimator's own sigma of it, degrees.
    pub pointing_sigma_deg: f64,
    /// Root mean square of the boresight's own error, degrees.
    pub boresight_rms_deg: f64,
    /// Root mean square of the clock's error, milliseconds.
    pub clock_rms_ms: f64,
    /// Mean of the estimator's own sigma of the clock, milliseconds.
    pub clock_sigma_ms: f64,
    /// Root mean square of clock error over its sigma.
    pub clock_error_over_sigma: f64,
    /// Share of the ellipses of the first half orbit that held the truth.
    pub early_coverage90: f64,
    /// Share of the last ellipses that did.
    pub last_coverage90: f64,
    /// Root mean square of the horizontal error in the end, metres.
    pub error_rms_m: f64,
}

/// Sums up.
#[must_use]
pub fn summary(flown: &[MountFlown]) -> MountSummary {
    let rms = |value: fn(&MountFlown) -> f64| mean(flown.iter().map(|f| value(f).powi(2))).sqrt();
    let early = flown
        .iter()
        .fold((0, 0), |sum, f| (sum.0 + f.early.0, sum.1 + f.early.1));
    MountSummary {
        flights: flown.len(),
        pointing_rms_deg: rms(|f| f.pointing_error_deg),
        pointing_sigma_deg: rms(|f| f.pointing_sigma_deg),
        boresight_rms_deg: rms(|f| f.boresight_error_deg),
        clock_rms_ms: rms(|f| f.clock_error_ms),
        clock_sigma_ms: mean(flown.iter().map(|f| f.clock_sigma_ms)),
        clock_error_over_sigma: rms(|f| f.clock_error_ms / f.clock_sigma_ms),
        early_coverage90: f64::from(early.1) / f64::from(early.0),
        last_coverage90: mean(flown.iter().map(|f| f64::from(u8::from(f.held)))),
        error_rms_m: rms(|f| f.error_m),
    }
}
