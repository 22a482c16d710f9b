//! The four ways to fly at a fire, with a fire at the origin: where the airframe truly is.

use emberfix_sim::noise::normal;
use emberfix_sim::state::BodyState;
use nalgebra::{Matrix3, Rotation3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::f64::consts::TAU;

/// A way to fly at a fire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// In one place, swaying.
    Hover,
    /// Towards the fire, to 0.4 of the first ground range.
    StraightIn,
    /// Past the fire, nose to it, on a track as long as the ground range.
    FlyBy,
    /// Around the fire, nose to it.
    Orbit,
}

impl Kind {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Hover, Self::StraightIn, Self::FlyBy, Self::Orbit];

    /// As tables name it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Hover => "hover",
            Self::StraightIn => "straight-in",
            Self::FlyBy => "fly-by",
            Self::Orbit => "orbit",
        }
    }
}

/// A flight about a fire at the origin of an east-north-up plane.
#[derive(Debug, Clone)]
pub struct Course {
    /// Way to fly.
    pub kind: Kind,
    /// Ground range at the start (fly-by: abeam), metres.
    pub ground_range_m: f64,
    /// Above the fire, metres.
    pub height_m: f64,
    /// Over ground, m/s.
    pub speed_m_s: f64,
    /// Where the flight begins (fly-by: where the track is abeam), seen from the fire, radians
    /// clockwise from north.
    pub azimuth_rad: f64,
    /// How long, seconds.
    pub duration_s: f64,
    /// Air that shakes the airframe.
    pub gusts: Gusts,
}

/// Smooth disturbance of attitude and place: sums of slow tones with phases by chance.
#[derive(Debug, Clone)]
pub struct Gusts {
    turn_rad: [Vec<Tone>; 3],
    sway_m: [Vec<Tone>; 3],
}

#[derive(Debug, Clone, Copy)]
struct Tone {
    amplitude: f64,
    rate_rad_s: f64,
    phase_rad: f64,
}

/// Tones per axis, and their band: an airframe of some kilograms answers gusts in seconds.
const TONES: usize = 4;
const BAND_HZ: std::ops::Range<f64> = 0.08..0.6;
const GRAVITY_M_S2: f64 = 9.80665;
/// Deceleration by drag per speed.
const DRAG_PER_S: f64 = 0.05;
const STEP_S: f64 = 0.002;
/// Share of the ground range that a straight flight leaves.
const STRAIGHT_LEFT: f64 = 0.4;

impl Gusts {
    /// Gusts that turn the airframe by `turn_deg` and push it by `sway_m`, one sigma per axis.
    #[must_use]
    pub fn new(rng: &mut ChaCha8Rng, turn_deg: f64, sway_m: f64) -> Self {
        let turn_rad = std::array::from_fn(|_| tones(rng, turn_deg.to_radians(), 1.0));
        let sway_m = std::array::from_fn(|_| tones(rng, sway_m, 0.3));
        Self { turn_rad, sway_m }
    }

    /// Air that does not move.
    #[must_use]
    pub fn calm() -> Self {
        Self {
            turn_rad: Default::default(),
            sway_m: Default::default(),
        }
    }
}

fn tones(rng: &mut ChaCha8Rng, sigma: f64, pace: f64) -> Vec<Tone> {
    let tone = |rng: &mut ChaCha8Rng| Tone {
        amplitude: sigma * (2.0 / TONES as f64).sqrt(),
        rate_rad_s: TAU * pace * rng.random_range(BAND_HZ),
        phase_rad: rng.random_range(0.0..TAU),
    };
    (0..TONES).map(|_| tone(rng)).collect()
}

fn sum(axes: &[Vec<Tone>; 3], t_s: f64) -> Vector3<f64> {
    Vector3::from_fn(|axis, _| {
        axes[axis]
            .iter()
            .map(|tone| tone.amplitude * (tone.phase_rad + tone.rate_rad_s * t_s).sin())
            .sum()
    })
}

impl Course {
    /// A course of `kind` from a slant range and height, with chance for the rest: speed 5 to 12 m/s
    /// (slower on tight circles), orbits of 120 to 360 degrees, gusts of 2 degrees.
    pub fn drawn(rng: &mut ChaCha8Rng, kind: Kind, slant_m: f64, height_m: f64) -> Self {
        let ground_range_m = (slant_m * slant_m - height_m * height_m).max(1.0).sqrt();
        let mut speed_m_s: f64 = rng.random_range(5.0..12.0);
        let around: f64 = rng.random_range(120.0_f64..360.0).to_radians();
        let duration_s = match kind {
            Kind::Hover => 40.0,
            Kind::StraightIn => (1.0 - STRAIGHT_LEFT) * ground_range_m / speed_m_s,
            Kind::FlyBy => ground_range_m / speed_m_s,
            Kind::Orbit => {
                // A multirotor leans up to about 10 degrees for its circle.
                speed_m_s = speed_m_s.min((1.8 * ground_range_m).sqrt());
                around * ground_range_m / speed_m_s
            }
        };
        Self {
            kind,
            ground_range_m,
            height_m,
            speed_m_s,
            azimuth_rad: rng.random_range(0.0..TAU),
            // Short flights are flown slower: a look takes its time.
            duration_s: duration_s.max(LEAST_S),
            gusts: Gusts::new(rng, 2.0, 0.3),
        }
        .slowed(duration_s)
    }

    fn slowed(mut self, planned_s: f64) -> Self {
        if planned_s < self.duration_s && self.kind != Kind::Hover {
            self.speed_m_s *= planned_s / self.duration_s;
        }
        self
    }

    fn place(&self, t_s: f64) -> Vector3<f64> {
        let out = |azimuth: f64| Vector3::new(azimuth.sin(), azimuth.cos(), 0.0);
        let away = out(self.azimuth_rad);
        let travelled = self.speed_m_s * t_s;
        let flat = match self.kind {
            Kind::Hover => away * self.ground_range_m,
            Kind::StraightIn => away * (self.ground_range_m - travelled),
            Kind::FlyBy => {
                let along = Vector3::new(away.y, -away.x, 0.0);
                let half = 0.5 * self.speed_m_s * self.duration_s;
                away * self.ground_range_m + along * (travelled - half)
            }
            Kind::Orbit => {
                out(self.azimuth_rad + travelled / self.ground_range_m) * self.ground_range_m
            }
        };
        flat + Vector3::new(0.0, 0.0, self.height_m) + sum(&self.gusts.sway_m, t_s)
    }

    fn velocity(&self, t_s: f64) -> Vector3<f64> {
        (self.place(t_s + STEP_S) - self.place(t_s - STEP_S)) / (2.0 * STEP_S)
    }

    fn attitude(&self, t_s: f64) -> Rotation3<f64> {
        let step = 0.05;
        let (before, after) = (self.velocity(t_s - step), self.velocity(t_s + step));
        let velocity = self.velocity(t_s);
        let thrust = (after - before) / (2.0 * step)
            + Vector3::new(velocity.x, velocity.y, 0.0) * DRAG_PER_S
            + Vector3::z() * GRAVITY_M_S2;
        // The plan's own place, so that sway does not turn the nose.
        let away = self.place(t_s) - sum(&self.gusts.sway_m, t_s);
        let nose = match self.kind {
            Kind::StraightIn => -Vector3::new(self.azimuth_rad.sin(), self.azimuth_rad.cos(), 0.0),
            _ => -Vector3::new(away.x, away.y, 0.0),
        };
        let down = -thrust.normalize();
        let right = down.cross(&nose).normalize();
        let forward = right.cross(&down);
        let calm = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[forward, right, down]));
        calm * Rotation3::from_scaled_axis(sum(&self.gusts.turn_rad, t_s))
    }

    /// Where the airframe truly is, `t_s` seconds after the start.
    #[must_use]
    pub fn state(&self, t_s: f64) -> BodyState {
        let (before, after) = (self.attitude(t_s - STEP_S), self.attitude(t_s + STEP_S));
        BodyState {
            t_s,
            position_m: self.place(t_s),
            enu_from_body: self.attitude(t_s).into_inner(),
            velocity_m_s: self.velocity(t_s),
            rate_rad_s: (before.inverse() * after).scaled_axis() / (2.0 * STEP_S),
        }
    }

    /// Times of `count` looks at most, `least_s` apart at least.
    #[must_use]
    pub fn looks(&self, count: usize, least_s: f64) -> Vec<f64> {
        let fits = (self.duration_s / least_s).floor() as usize + 1;
        let count = count.min(fits).max(2);
        let step = self.duration_s / (count - 1) as f64;
        (0..count).map(|look| step * look as f64).collect()
    }

    /// How far below the nose the fire stands, seen from the airframe, averaged over the flight:
    /// what a camera would be mounted at, degrees.
    #[must_use]
    pub fn mean_depression_deg(&self) -> f64 {
        let samples = 9;
        let at = |i: usize| {
            let state = self.state(self.duration_s * i as f64 / (samples - 1) as f64);
            let body = state.enu_from_body.transpose() * -state.position_m;
            body.z.atan2(body.x).to_degrees()
        };
        (0..samples).map(at).sum::<f64>() / samples as f64
    }
}

/// No flight is shorter: looks must span the time that a fire takes to be confirmed.
const LEAST_S: f64 = 6.0;

/// A draw between two positive numbers, even in the logarithm.
pub fn log_uniform(rng: &mut ChaCha8Rng, low: f64, high: f64) -> f64 {
    (rng.random_range(low.ln()..high.ln())).exp()
}

/// Three normal draws of one sigma.
pub fn normal3(rng: &mut ChaCha8Rng, sigma: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| sigma * normal(rng))
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberfix_sim::noise::stream;

    #[test]
    fn every_kind_keeps_the_fire_ahead_and_its_rates_are_those_of_its_attitude() {
        for kind in Kind::ALL {
            let course = Course::drawn(&mut stream(3, kind.name()), kind, 90.0, 40.0);
            for t_s in course.looks(12, 0.3) {
                let state = course.state(t_s);
                let fire = state.enu_from_body.transpose() * -state.position_m;
                assert!(fire.x > 0.0, "{kind:?}: fire behind the nose");
                let turned =
                    state.enu_from_body.transpose() * course.state(t_s + 0.01).enu_from_body;
                let turn = Rotation3::from_matrix(&turned).scaled_axis() / 0.01;
                // Gusts accelerate the turn by up to 0.5 rad/s^2: 0.005 rad/s in 10 ms.
                assert!((turn - state.rate_rad_s).norm() < 0.01, "{kind:?}");
            }
        }
    }

    #[test]
    fn a_straight_flight_ends_at_its_share_of_the_range() {
        let mut course = Course::drawn(&mut stream(1, "s"), Kind::StraightIn, 100.0, 30.0);
        course.gusts = Gusts::calm();
        let end = course.state(course.duration_s).position_m;
        assert!((end.xy().norm() - 0.4 * course.ground_range_m).abs() < 1e-6);
        assert!((end.z - 30.0).abs() < 1e-9);
    }
}
