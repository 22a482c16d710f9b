//! Fires that run: where the ground burns, and where the front is.
//!
//! The burning ground is an oval that keeps its shape and grows about the place of ignition: its head
//! runs with the stated speed, flanks and back with a share of it. Flames of the fire's own size stand
//! all along the front, and behind it where the front has passed within
//! [`SpreadConfig::residence_s`].

use super::SpreadConfig;
use super::burning::unit;
use nalgebra::{Rotation2, Vector2};

/// How one fire runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Unit vector of the head: east, north.
    pub towards: Vector2<f64>,
    /// Speed of the head, m/s.
    pub speed_m_s: f64,
    flank: f64,
    back: f64,
    residence_s: f64,
}

/// Sites behind the front at most: beyond, they stand further apart.
const MOST_SITES: f64 = 80.0;
/// Spacing of the sites against the width of a flame.
const SPACING: f64 = 0.7;

impl Spread {
    /// Flames along the front; the first of [`Spread::sites`].
    pub(super) const FRONT: usize = 36;

    pub(super) fn new(config: &SpreadConfig) -> Self {
        let azimuth = config.azimuth_deg.to_radians();
        Self {
            towards: Vector2::new(azimuth.sin(), azimuth.cos()),
            speed_m_s: config.speed_m_s,
            flank: config.flank,
            back: config.back,
            residence_s: config.residence_s,
        }
    }

    /// Half length, half width and middle (along the head) of the oval after one second, metres.
    fn oval(&self) -> (f64, f64, f64) {
        let v = self.speed_m_s;
        (
            v * (1.0 + self.back) / 2.0,
            v * self.flank,
            v * (1.0 - self.back) / 2.0,
        )
    }

    /// How far the front has come from the place of ignition in the direction of the unit vector
    /// `outwards` (the oval's support function), metres.
    #[must_use]
    pub fn reach_m(&self, outwards: &Vector2<f64>, age_s: f64) -> f64 {
        let (long, wide, middle) = self.oval();
        let along = self.towards.dot(outwards);
        let across = self.towards.perp(outwards);
        age_s * (middle * along + (long * along).hypot(wide * across))
    }

    /// Seconds after ignition at which the front reaches a place, east and north of the ignition.
    fn arrival_s(&self, place: &Vector2<f64>) -> f64 {
        let (long, wide, middle) = self.oval();
        let (x, y) = (self.towards.dot(place), self.towards.perp(place));
        // ((k x - m) / a)² + (k y / b)² = 1 for k = 1 / age.
        let (p, q) = (
            (x / long).powi(2) + (y / wide).powi(2),
            x * middle / (long * long),
        );
        let rest = (middle / long).powi(2) - 1.0;
        let k = (q + (q * q - p * rest).max(0.0).sqrt()) / p.max(1e-12);
        1.0 / k.max(1e-9)
    }

    /// A point of the oval after one second, by its angle from the middle.
    fn on_front(&self, angle: f64) -> Vector2<f64> {
        let (long, wide, middle) = self.oval();
        let (sin, cos) = angle.sin_cos();
        let left = Vector2::new(-self.towards.y, self.towards.x);
        self.towards * (middle + long * cos) + left * (wide * sin)
    }

    /// Places that burn at an age, from the place of ignition: where the front has passed lately.
    pub(super) fn sites(&self, seed: u64, flame_width_m: f64, age_s: f64) -> Vec<Vector2<f64>> {
        let (long, wide, middle) = self.oval();
        let area = std::f64::consts::PI * long * wide * age_s * age_s;
        // Whole doublings, so that a site stays where it is while the fire grows.
        let crowded = area / (SPACING * flame_width_m).powi(2) / MOST_SITES;
        let spacing = SPACING * flame_width_m * 2_f64.powf((crowded.log2() / 2.0).ceil().max(0.0));
        let turn = Rotation2::rotation_between(&Vector2::x(), &self.towards);
        let cells = |half: f64| (half * age_s / spacing).ceil() as i32 + 1;
        let first = (middle * age_s / spacing) as i32;
        let mut sites: Vec<Vector2<f64>> = (0..Self::FRONT)
            .map(|k| self.on_front(std::f64::consts::TAU * k as f64 / Self::FRONT as f64) * age_s)
            .collect();
        for i in first - cells(long)..=first + cells(long) {
            for j in -cells(wide)..=cells(wide) {
                let jitter = |salt| {
                    0.5 * (unit(seed, (i + 4096) as u32, ((j + 4096) * 2 + salt) as u32) - 0.5)
                };
                let cell = Vector2::new(f64::from(i) + jitter(0), f64::from(j) + jitter(1));
                let place = turn * (cell * spacing);
                let since_s = age_s - self.arrival_s(&place);
                if (0.0..self.residence_s).contains(&since_s) {
                    sites.push(place);
                }
            }
        }
        sites
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spread() -> Spread {
        Spread::new(&SpreadConfig {
            fire: "a".to_owned(),
            azimuth_deg: 90.0,
            speed_m_s: 0.5,
            flank: 0.4,
            back: 0.1,
            residence_s: 1e3,
        })
    }

    #[test]
    fn head_flank_and_back_run_as_stated() {
        let spread = spread();
        let reach = |east, north| spread.reach_m(&Vector2::new(east, north), 20.0);
        assert!((reach(1.0, 0.0) - 10.0).abs() < 1e-9);
        assert!((reach(-1.0, 0.0) - 1.0).abs() < 1e-9);
        assert!((reach(0.0, 1.0) - 4.0).abs() < 1e-9);
        assert!((spread.arrival_s(&Vector2::new(10.0, 0.0)) - 20.0).abs() < 1e-6);
        assert!((spread.arrival_s(&Vector2::new(-1.0, 0.0)) - 20.0).abs() < 1e-6);
    }

    #[test]
    fn sites_fill_the_oval_up_to_its_front_and_never_leave_it() {
        let sites = spread().sites(3, 1.0, 20.0);
        assert!((20..400).contains(&sites.len()), "{}", sites.len());
        let head = sites.iter().map(|site| site.x).fold(0.0, f64::max);
        assert!((head - 10.0).abs() < 1e-9, "{head}");
        assert!(sites.iter().all(|site| site.y.abs() <= 4.0 + 1e-9));
    }
}
