//! The way through the air, as a twice differentiable function of time.

use nalgebra::Vector3;
use serde::Deserialize;

/// `[sim.flight.path]`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(tag = "pattern", rename_all = "snake_case", deny_unknown_fields)]
pub enum PathConfig {
    /// Through points, nose along the course or held on one place.
    Patrol {
        /// East, north, height above the ground there; metres.
        waypoints_m: Vec<[f64; 3]>,
        /// Mean speed along the legs, m/s.
        speed_m_s: f64,
        /// How often to fly through all of them, from the last to the first again.
        #[serde(default = "one_lap")]
        laps: u16,
        /// East, north of the place on which the nose is held (the autopilot's region of interest), metres;
        /// along the course when absent.
        #[serde(default)]
        look_at_m: Option<[f64; 2]>,
    },
    /// Around a point.
    Orbit {
        /// East, north of the centre, metres.
        centre_m: [f64; 2],
        /// Radius, metres.
        radius_m: f64,
        /// Above the ground at the centre, metres.
        height_above_ground_m: f64,
        /// Speed along the circle, m/s.
        speed_m_s: f64,
        /// Where the flight begins, seen from the centre; clockwise from north.
        start_azimuth_deg: f64,
        /// Seen from above.
        clockwise: bool,
        /// Where the nose points.
        nose: Nose,
    },
}

fn one_lap() -> u16 {
    1
}

/// Where the nose points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Nose {
    /// Along the motion.
    Course,
    /// To the orbit's centre.
    Centre,
}

#[derive(Debug, Clone)]
pub(super) enum Path {
    Patrol {
        way: Spline,
        look_at_m: Option<Vector3<f64>>,
    },
    Orbit(Orbit),
}

#[derive(Debug, Clone)]
pub(super) struct Orbit {
    centre_m: Vector3<f64>,
    radius_m: f64,
    start_rad: f64,
    rate_rad_s: f64,
    nose: Nose,
}

impl Path {
    pub(super) fn new(config: &PathConfig, ground_up_m: impl Fn(f64, f64) -> f64) -> Self {
        match config {
            PathConfig::Patrol {
                waypoints_m,
                speed_m_s,
                laps,
                look_at_m,
            } => {
                let above_ground = |&[east, north, height]: &[f64; 3]| {
                    Vector3::new(east, north, ground_up_m(east, north) + height)
                };
                let lap: Vec<_> = waypoints_m.iter().map(above_ground).collect();
                let points = lap.repeat(usize::from(*laps));
                Self::Patrol {
                    way: Spline::new(points, *speed_m_s),
                    look_at_m: look_at_m.map(|[east, north]| Vector3::new(east, north, 0.0)),
                }
            }
            PathConfig::Orbit {
                centre_m: [east, north],
                radius_m,
                height_above_ground_m,
                speed_m_s,
                start_azimuth_deg,
                clockwise,
                nose,
            } => {
                let up = ground_up_m(*east, *north) + height_above_ground_m;
                let rate = speed_m_s / radius_m;
                Self::Orbit(Orbit {
                    centre_m: Vector3::new(*east, *north, up),
                    radius_m: *radius_m,
                    start_rad: start_azimuth_deg.to_radians(),
                    rate_rad_s: if *clockwise { rate } else { -rate },
                    nose: *nose,
                })
            }
        }
    }

    pub(super) fn position_m(&self, t_s: f64) -> Vector3<f64> {
        match self {
            Self::Patrol { way, .. } => way.at(t_s),
            Self::Orbit(orbit) => orbit.at(t_s),
        }
    }

    /// The wanted direction of the nose, level.
    pub(super) fn nose(&self, t_s: f64, velocity_m_s: Vector3<f64>) -> Vector3<f64> {
        let nose = match self {
            Self::Orbit(orbit) if orbit.nose == Nose::Centre => orbit.centre_m - orbit.at(t_s),
            Self::Patrol {
                way,
                look_at_m: Some(place),
            } => place - way.at(t_s),
            _ => velocity_m_s,
        };
        Vector3::new(nose.x, nose.y, 0.0)
    }
}

impl Orbit {
    fn at(&self, t_s: f64) -> Vector3<f64> {
        let azimuth = self.start_rad + self.rate_rad_s * t_s;
        self.centre_m + Vector3::new(azimuth.sin(), azimuth.cos(), 0.0) * self.radius_m
    }
}

/// Natural cubic spline over time: position, velocity and acceleration are continuous, and straight
/// on beyond both ends.
#[derive(Debug, Clone)]
pub(super) struct Spline {
    times_s: Vec<f64>,
    points_m: Vec<Vector3<f64>>,
    /// Second derivatives at the points.
    bends_m_s2: Vec<Vector3<f64>>,
}

impl Spline {
    fn new(points_m: Vec<Vector3<f64>>, speed_m_s: f64) -> Self {
        let mut times_s = vec![0.0];
        let mut at_s = 0.0;
        for leg in points_m.windows(2) {
            at_s += (leg[1] - leg[0]).norm() / speed_m_s;
            times_s.push(at_s);
        }
        let bends_m_s2 = bends(&times_s, &points_m);
        Self {
            times_s,
            points_m,
            bends_m_s2,
        }
    }

    fn at(&self, t_s: f64) -> Vector3<f64> {
        let last = self.times_s.len() - 1;
        let leg = self
            .times_s
            .partition_point(|&time| time <= t_s)
            .clamp(1, last);
        let inside = t_s.clamp(self.times_s[leg - 1], self.times_s[leg]);
        self.cubic(leg, inside) + self.slope(leg, inside) * (t_s - inside)
    }

    fn cubic(&self, leg: usize, t_s: f64) -> Vector3<f64> {
        let span = self.times_s[leg] - self.times_s[leg - 1];
        let (a, b) = (
            (self.times_s[leg] - t_s) / span,
            (t_s - self.times_s[leg - 1]) / span,
        );
        let bend =
            self.bends_m_s2[leg - 1] * (a.powi(3) - a) + self.bends_m_s2[leg] * (b.powi(3) - b);
        self.points_m[leg - 1] * a + self.points_m[leg] * b + bend * (span * span / 6.0)
    }

    fn slope(&self, leg: usize, t_s: f64) -> Vector3<f64> {
        let span = self.times_s[leg] - self.times_s[leg - 1];
        let (a, b) = (
            (self.times_s[leg] - t_s) / span,
            (t_s - self.times_s[leg - 1]) / span,
        );
        (self.points_m[leg] - self.points_m[leg - 1]) / span
            + (self.bends_m_s2[leg] * (3.0 * b * b - 1.0)
                - self.bends_m_s2[leg - 1] * (3.0 * a * a - 1.0))
                * (span / 6.0)
    }
}

/// Solves the tridiagonal system of a natural spline (Thomas' elimination).
fn bends(times_s: &[f64], points_m: &[Vector3<f64>]) -> Vec<Vector3<f64>> {
    let count = points_m.len();
    let mut bends = vec![Vector3::zeros(); count];
    let mut upper = vec![0.0; count];
    for i in 1..count.saturating_sub(1) {
        let (before, after) = (times_s[i] - times_s[i - 1], times_s[i + 1] - times_s[i]);
        let slopes =
            (points_m[i + 1] - points_m[i]) / after - (points_m[i] - points_m[i - 1]) / before;
        let pivot = 2.0 * (before + after) - before * upper[i - 1];
        upper[i] = after / pivot;
        bends[i] = (slopes * 6.0 - bends[i - 1] * before) / pivot;
    }
    for i in (1..count.saturating_sub(1)).rev() {
        let next = bends[i + 1];
        bends[i] -= next * upper[i];
    }
    bends
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spline() -> Spline {
        let points = [
            [0.0, 0.0, 10.0],
            [30.0, 5.0, 12.0],
            [40.0, 40.0, 8.0],
            [0.0, 50.0, 9.0],
        ];
        Spline::new(points.iter().map(|p| Vector3::from(*p)).collect(), 5.0)
    }

    #[test]
    fn a_patrol_goes_through_its_waypoints() {
        let spline = spline();
        for (time, point) in spline.times_s.iter().zip(&spline.points_m) {
            assert!((spline.at(*time) - point).norm() < 1e-9);
        }
    }

    #[test]
    fn a_second_lap_comes_by_the_first_waypoint_again() {
        let waypoints_m = vec![[0.0, 0.0, 10.0], [30.0, 0.0, 10.0], [0.0, 40.0, 10.0]];
        let path = Path::new(
            &PathConfig::Patrol {
                waypoints_m,
                speed_m_s: 5.0,
                laps: 2,
                look_at_m: None,
            },
            |_, _| 0.0,
        );
        // 30 m, 50 m and 40 m at 5 m/s.
        let again = path.position_m(24.0);
        assert!((again - Vector3::new(0.0, 0.0, 10.0)).norm() < 1e-9);
    }

    #[test]
    fn a_nose_that_is_held_on_a_place_points_there_whatever_the_course() {
        let path = Path::new(
            &PathConfig::Patrol {
                waypoints_m: vec![[0.0, -20.0, 10.0], [15.0, -20.0, 10.0]],
                speed_m_s: 5.0,
                laps: 1,
                look_at_m: Some([0.0, 0.0]),
            },
            |_, _| 0.0,
        );
        let eastward = Vector3::new(5.0, 0.0, 0.0);
        let nose = path.nose(0.0, eastward).normalize();
        assert!(
            (nose - Vector3::y()).norm() < 1e-12,
            "north from the south: {nose}"
        );
        let nose = path.nose(3.0, eastward);
        assert!(
            nose.x < 0.0 && nose.y > 0.0,
            "north-west from the south-east: {nose}"
        );
    }

    #[test]
    fn velocity_and_acceleration_have_no_steps_at_waypoints_nor_at_the_ends() {
        let spline = spline();
        let h = 1e-3;
        let acceleration =
            |t: f64| (spline.at(t + h) - 2.0 * spline.at(t) + spline.at(t - h)) / (h * h);
        for time in spline.times_s.clone() {
            // 0.05 m/s2: third derivative (jerk of about 1 m/s3) over 20 ms, and rounding.
            assert!((acceleration(time + 0.01) - acceleration(time - 0.01)).norm() < 0.05);
        }
    }
}
