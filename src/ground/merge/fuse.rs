//! One position from several that may err together.
//!
//! Aircraft share map, terrain and geoid errors, often a GNSS atmosphere and always a detector; an
//! alarm says how large its error is, not how much of it the others share. Covariance intersection
//! (Julier and Uhlmann, "A non-divergent estimation algorithm in the presence of unknown
//! correlations", ACC 1997) is consistent whatever that share is:
//! `P^-1 = w A^-1 + (1 - w) B^-1`, `0 <= w <= 1`. Two views from one place have one ellipse, and so
//! has their fusion; views across each other's line of sight cut each other's long axes.
//! **Known limit:** when errors are in truth independent, the ellipse is larger than need be.

use crate::alarm::Alarm;
use emberfix_frames::{
    Coordinate, Covariance, Matrix3, Metres, MissionEnu, ServiceTime, Vector3, Wgs84,
    ecef_from_enu, enu_offset, place_from_ecef,
};

/// Speed that a burning spot may wander unseen, m/s, for a sighting older than another's.
const WANDER_M_S: f64 = 0.02;
/// Least variance in any direction, m²: one millimetre, so that every matrix can be inverted.
const LEAST_VARIANCE_M2: f64 = 1e-6;
/// Steps of the golden section; each shrinks the interval to 0.618.
const STEPS: u32 = 24;

/// A position with its error and when it held.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Estimate {
    pub place: Wgs84,
    /// In the tangent plane at the place.
    pub covariance: Covariance<MissionEnu>,
    pub at: ServiceTime,
}

impl Estimate {
    /// What an alarm says of its place. An alarm with a broken covariance is not let in; should one
    /// be on an old disk, its circle stands in.
    pub fn of(alarm: &Alarm) -> Self {
        let circle = |_| {
            let sigma = alarm.properties.ce90_m / 2.146;
            Covariance::from_sigmas_m(sigma, sigma, alarm.properties.le90_m / 1.645)
        };
        Self {
            place: alarm.place,
            covariance: alarm.covariance().unwrap_or_else(circle),
            at: alarm.properties.captured_at,
        }
    }
}

/// Fuses all; `None` of none. The order changes nothing: the best goes first.
pub(crate) fn fuse(estimates: &[Estimate]) -> Option<Estimate> {
    let newest = estimates.iter().map(|estimate| estimate.at).max()?;
    if let [only] = estimates {
        return Some(only.clone());
    }
    let mut sorted: Vec<(f64, &Estimate)> = estimates
        .iter()
        .map(|estimate| (aged(estimate, newest).trace(), estimate))
        .collect();
    sorted.sort_by(|(a, one), (b, other)| {
        a.total_cmp(b).then_with(|| {
            key(one)
                .partial_cmp(&key(other))
                .unwrap_or(std::cmp::Ordering::Equal)
        })
    });
    let origin = sorted.first()?.1.place;
    let mut mean = Vector3::zeros();
    let mut covariance = aged(sorted.first()?.1, newest);
    for (_, next) in &sorted[1..] {
        let offset = enu_offset(&origin, &next.place);
        (mean, covariance) = intersect((mean, covariance), (offset, aged(next, newest)))?;
    }
    let point = Coordinate::<MissionEnu>::from_metres(mean);
    Some(Estimate {
        place: place_from_ecef(&ecef_from_enu(&origin).transform(point))?,
        covariance: Covariance::new(covariance).ok()?,
        at: newest,
    })
}

fn key(estimate: &Estimate) -> [f64; 3] {
    use emberfix_frames::Wgs84Parts;
    let place = &estimate.place;
    [
        place.latitude_deg(),
        place.longitude_deg(),
        place.height().m(),
    ]
}

/// The covariance at a later time, m², and never singular.
pub(crate) fn aged(estimate: &Estimate, until: ServiceTime) -> Matrix3<f64> {
    let wander_m = WANDER_M_S * (until - estimate.at).as_secs_f64().max(0.0);
    let mut m2 = *estimate.covariance.m2();
    for axis in 0..3 {
        let level = if axis < 2 { wander_m * wander_m } else { 0.0 };
        m2[(axis, axis)] += level + LEAST_VARIANCE_M2;
    }
    m2
}

/// Covariance intersection of two, with the weight that makes the volume least.
fn intersect(
    (a, a_m2): (Vector3<f64>, Matrix3<f64>),
    (b, b_m2): (Vector3<f64>, Matrix3<f64>),
) -> Option<(Vector3<f64>, Matrix3<f64>)> {
    let (a_information, b_information) = (a_m2.try_inverse()?, b_m2.try_inverse()?);
    let information = |weight: f64| a_information * weight + b_information * (1.0 - weight);
    // The determinant is log-concave in the weight, so one maximum is to be found.
    let weight = maximum(|weight| information(weight).determinant());
    let m2 = information(weight).try_inverse()?;
    let mean = m2 * (a_information * a * weight + b_information * b * (1.0 - weight));
    Some((mean, (m2 + m2.transpose()) * 0.5))
}

/// Where in 0..1 a function with one maximum is greatest: golden section, the ends included.
fn maximum(value: impl Fn(f64) -> f64) -> f64 {
    const RATIO: f64 = 0.618_033_988_749_894_8;
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..STEPS {
        let (left, right) = (high - RATIO * (high - low), low + RATIO * (high - low));
        if value(left) < value(right) {
            low = left
        } else {
            high = right
        }
    }
    [1.0, 0.0, 0.5 * (low + high)]
        .into_iter()
        .reduce(|best, next| {
            if value(next) > value(best) {
                next
            } else {
                best
            }
        })
        .unwrap_or(1.0)
}
