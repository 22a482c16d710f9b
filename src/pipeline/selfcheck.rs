//! Whether the rig still is what its file says: judged in flight, from what both eyes see. Pure.
//!
//! **In:** [`EyesCompared`] once a second, the disparity that the terrain promises at each place, the
//! estimator's disparity offset. **Out:** [`Fault`]s, each with its name for alarms and words for people,
//! and how much wider disparities are to be taken while they last.
//!
//! A fault is called when the median of the last [`WINDOW`] comparisons is beyond its limit, and taken
//! back when it is well within: one bad picture calls nothing.
//!
//! **Known limits.** A vergence error alone moves nothing up or down: only terrain, or flying past a
//! fire, shows it. Eyes of different kind (near-infrared beside colour) differ in sharpness and gain for
//! good, and are flagged for it.

use crate::range::EyesCompared;
use emberfix_calib::RectifiedPixel;
use std::collections::VecDeque;

/// What may be wrong with a rig.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Fault {
    /// Rows of the eyes do not meet any more: the rig is bent.
    RowsApart,
    /// Disparities of the ground are not those that the terrain promises: vergence has drifted.
    DisparityOff,
    /// Stereo and flying past disagree: vergence has drifted.
    ParallaxDisagrees,
    /// The left eye is out of focus or dirty.
    LeftBlurred,
    /// The right eye is.
    RightBlurred,
    /// One eye is much brighter than the other.
    GainApart,
    /// Hardly anything that the left eye sees is found in the right one.
    EyesUnlike,
}

impl Fault {
    /// As the alarm's `degraded` names it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::RowsApart => "rig_drifted_rows",
            Self::DisparityOff => "rig_drifted_terrain",
            Self::ParallaxDisagrees => "rig_drifted_parallax",
            Self::LeftBlurred => "lens_left",
            Self::RightBlurred => "lens_right",
            Self::GainApart => "eyes_gain",
            Self::EyesUnlike => "eyes_unlike",
        }
    }

    /// As the operator is told, in the 50 bytes of a STATUSTEXT.
    #[must_use]
    pub const fn words(self) -> &'static str {
        match self {
            Self::RowsApart => "stereo rig is bent: calibrate it again",
            Self::DisparityOff => "stereo disagrees with terrain: calibrate it",
            Self::ParallaxDisagrees => "stereo disagrees with parallax: calibrate it",
            Self::LeftBlurred => "left eye out of focus or dirty",
            Self::RightBlurred => "right eye out of focus or dirty",
            Self::GainApart => "eyes are not equally bright",
            Self::EyesUnlike => "right eye sees something else, or nothing",
        }
    }
}

/// Comparisons that are remembered.
pub const WINDOW: usize = 7;
/// Comparisons before anything is called.
const ENOUGH: usize = 4;
/// Places in a comparison before it counts.
const PLACES: usize = 10;
/// Rows apart, pixels. Calibrations leave 0.3; 0.5 px is 0.03 degrees at 880 px.
const ROWS_PX: f64 = 0.5;
/// Sharpness of one eye over the other.
const SHARPNESS: f64 = 1.45;
/// Brightness of one eye over the other.
const GAIN: f64 = 1.8;
/// Share of places that must be found again.
const FOUND: f64 = 0.25;
/// A disparity offset is called beyond this many of its sigmas, and of the rig's own.
const SIGMAS: f64 = 3.5;
/// And beyond this, pixels, whatever its sigma: trees stand on the ground that the terrain knows.
const OFFSET_PX: f64 = 0.4;
/// A fault is taken back below this share of its limit.
const BACK: f64 = 0.7;
/// A disparity offset is the same in each picture, and sightings would average it away as if it were
/// noise: it is written this many times larger, the square root of the sightings of a fly-past.
const SAME_EACH_TIME: f64 = 6.0;
/// Pairs of ground disparities that are kept of one comparison.
const GROUND: usize = 24;
/// Spread of the promised disparities, pixels, without which slope and offset are one.
const SPREAD_PX: f64 = 1.0;

/// A window of medians.
#[derive(Debug, Clone, Default)]
struct Window(VecDeque<f64>);

impl Window {
    fn push(&mut self, value: f64) {
        if self.0.len() == WINDOW {
            self.0.pop_front();
        }
        self.0.push_back(value);
    }

    fn value(&self) -> Option<f64> {
        (self.0.len() >= ENOUGH).then(|| median(self.0.iter().copied()))?
    }
}

/// Watches one rig.
#[derive(Debug, Clone)]
pub struct SelfCheck {
    disparity_sigma_px: f64,
    rows: Window,
    sharpness: Window,
    gain: Window,
    found: Window,
    /// Promised and measured disparities of the ground.
    ground: VecDeque<Vec<(f64, f64)>>,
    /// Offset of the disparity against terrain, and its sigma, pixels.
    offset: Option<(f64, f64)>,
    parallax: Option<(f64, f64)>,
    faults: Vec<Fault>,
}

impl SelfCheck {
    /// For a rig whose disparity offset is known to `disparity_sigma_px`.
    #[must_use]
    pub fn new(disparity_sigma_px: f64) -> Self {
        Self {
            disparity_sigma_px,
            rows: Window::default(),
            sharpness: Window::default(),
            gain: Window::default(),
            found: Window::default(),
            ground: VecDeque::new(),
            offset: None,
            parallax: None,
            faults: Vec::new(),
        }
    }

    /// Takes a comparison in; `promised` is the disparity of the ground behind a pixel, where known.
    pub fn note(
        &mut self,
        compared: &EyesCompared,
        promised: impl Fn(RectifiedPixel) -> Option<f64>,
    ) {
        if compared.tried >= 2 * PLACES {
            self.found
                .push(compared.found.len() as f64 / compared.tried as f64);
        }
        if compared.found.len() >= PLACES {
            let all = &compared.found;
            let mut note = |window: fn(&mut Self) -> &mut Window, value: Option<f64>| {
                if let Some(value) = value {
                    window(self).push(value);
                }
            };
            note(|s| &mut s.rows, median(all.iter().map(|p| p.vertical_px)));
            note(
                |s| &mut s.sharpness,
                median(all.iter().map(|p| p.sharpness.ln())),
            );
            note(|s| &mut s.gain, median(all.iter().map(|p| p.gain.ln())));
            let every = all.len().div_ceil(GROUND);
            let ground = all.iter().step_by(every);
            let pairs = ground
                .filter_map(|place| Some((promised(place.left)?, place.disparity_px)))
                .collect();
            if self.ground.len() == WINDOW {
                self.ground.pop_front();
            }
            self.ground.push_back(pairs);
            self.offset = (self.ground.len() >= ENOUGH)
                .then(|| offset(self.ground.iter().flatten().copied().collect()))
                .flatten();
        }
        self.judge();
    }

    /// Takes the estimator's word in: disparity offset and its sigma, pixels, where sightings told it.
    pub fn note_estimate(&mut self, offset_px: Option<(f64, f64)>) {
        self.parallax = offset_px;
        self.judge();
    }

    /// What is wrong, worst first.
    #[must_use]
    pub fn faults(&self) -> &[Fault] {
        &self.faults
    }

    /// Rows apart, pixels, of the last comparisons.
    #[must_use]
    pub fn rows_px(&self) -> Option<f64> {
        self.rows.value()
    }

    /// The sigma that a disparity gets while the faults last, pixels.
    #[must_use]
    pub fn widened(&self, sigma_px: f64) -> f64 {
        let mut wide = sigma_px;
        for fault in &self.faults {
            let more = match fault {
                // A bend is as likely sideways as upwards.
                Fault::RowsApart => self.rows_px().unwrap_or(0.0).abs() * SAME_EACH_TIME,
                Fault::DisparityOff => {
                    self.offset.map_or(0.0, |(offset, _)| offset.abs()) * SAME_EACH_TIME
                }
                Fault::ParallaxDisagrees => {
                    self.parallax.map_or(0.0, |(offset, _)| offset.abs()) * SAME_EACH_TIME
                }
                Fault::LeftBlurred | Fault::RightBlurred => {
                    sigma_px * self.sharpness.value().unwrap_or(0.0).abs().exp()
                }
                Fault::EyesUnlike => UNLIKE_PX,
                Fault::GainApart => 0.0,
            };
            wide = wide.hypot(more);
        }
        wide
    }

    fn judge(&mut self) {
        let over = |value: Option<f64>, limit: f64| value.map_or(0.0, |value| value.abs() / limit);
        let sharpness = self.sharpness.value().map(|ratio| ratio / SHARPNESS.ln());
        let shares = [
            (Fault::EyesUnlike, self.unlike()),
            (Fault::RowsApart, over(self.rows_px(), ROWS_PX)),
            (Fault::DisparityOff, self.off(self.offset)),
            (Fault::ParallaxDisagrees, self.off(self.parallax)),
            // The left eye is the blurred one where its edges are the weaker ones.
            (Fault::LeftBlurred, sharpness.map_or(0.0, |share| -share)),
            (Fault::RightBlurred, sharpness.unwrap_or(0.0)),
            (Fault::GainApart, over(self.gain.value(), GAIN.ln())),
        ];
        self.faults = shares
            .into_iter()
            .filter(|(fault, share)| {
                let limit = if self.faults.contains(fault) {
                    BACK
                } else {
                    1.0
                };
                *share > limit
            })
            .map(|(fault, _)| fault)
            .collect();
    }

    fn unlike(&self) -> f64 {
        self.found
            .value()
            .map_or(0.0, |share| FOUND / share.max(1e-3))
    }

    /// How far an offset is beyond what may be.
    fn off(&self, offset: Option<(f64, f64)>) -> f64 {
        offset.map_or(0.0, |(value, sigma)| {
            let limit = (SIGMAS * sigma.hypot(self.disparity_sigma_px)).max(OFFSET_PX);
            value.abs() / limit
        })
    }
}

/// Sigma of a disparity when the eyes hardly see the same, pixels: it says nothing.
const UNLIKE_PX: f64 = 20.0;

/// The middle of some values; `None` of none.
fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut sorted: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied()
}

/// Offset of measured against promised disparities and its sigma, with a slope of its own (a height
/// error scales all disparities alike), by weights that let trees and holes go.
fn offset(pairs: Vec<(f64, f64)>) -> Option<(f64, f64)> {
    let (mut slope, mut at_zero, mut scale) = (1.0, 0.0, f64::INFINITY);
    let mut sigma = f64::INFINITY;
    for _ in 0..10 {
        let weights: Vec<f64> = pairs
            .iter()
            .map(|(x, y)| {
                let off = (y - at_zero - slope * x) / (2.0 * scale);
                1.0 / (1.0 + off * off)
            })
            .collect();
        let total: f64 = weights.iter().sum();
        let mean = |of: &dyn Fn(&(f64, f64)) -> f64| {
            let sum: f64 = pairs.iter().zip(&weights).map(|(p, w)| of(p) * w).sum();
            sum / total
        };
        if total < 2.0 * PLACES as f64 {
            return None;
        }
        let (mx, my) = (mean(&|p| p.0), mean(&|p| p.1));
        let variance = mean(&|p| (p.0 - mx).powi(2));
        if variance.sqrt() < SPREAD_PX {
            return None;
        }
        slope = mean(&|p| (p.0 - mx) * (p.1 - my)) / variance;
        at_zero = my - slope * mx;
        let residuals = pairs.iter().map(|(x, y)| (y - at_zero - slope * x).abs());
        // 1.48: median of absolute values to sigma, of a normal distribution.
        scale = (1.48 * median(residuals)?).max(0.05);
        sigma = scale * ((1.0 + mx * mx / variance) / total).sqrt();
    }
    Some((at_zero, sigma))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::range::SamePlace;

    /// Ground disparities of 2 to 10 px, small scatter.
    fn eyes(change: impl Fn(&mut SamePlace)) -> EyesCompared {
        let place = |k: usize| {
            let disparity_px = 2.0 + 8.0 * (k as f64 / 40.0) + 0.1 * ((k * 7) as f64).sin();
            let mut place = SamePlace {
                left: RectifiedPixel {
                    u: 2.0 + 8.0 * (k as f64 / 40.0),
                    v: 0.0,
                },
                disparity_px,
                vertical_px: 0.1 * ((k * 3) as f64).sin(),
                gain: 1.02,
                sharpness: 1.0,
            };
            change(&mut place);
            place
        };
        EyesCompared {
            tried: 50,
            found: (0..40).map(place).collect(),
        }
    }

    /// The pixel's column is the promised disparity: enough of a terrain here.
    fn after(comparisons: usize, change: impl Fn(&mut SamePlace)) -> SelfCheck {
        let mut check = SelfCheck::new(0.1);
        for _ in 0..comparisons {
            check.note(&eyes(&change), |pixel| Some(pixel.u));
        }
        check
    }

    #[test]
    fn a_good_rig_has_no_fault_and_nothing_is_widened() {
        let check = after(20, |_| {});
        assert_eq!(check.faults(), []);
        assert_eq!(check.widened(0.3), 0.3);
    }

    #[test]
    fn one_bad_picture_calls_nothing() {
        let mut check = after(6, |_| {});
        check.note(&eyes(|place| place.vertical_px += 3.0), |_| None);
        assert_eq!(check.faults(), []);
    }

    #[test]
    fn a_bent_rig_is_named_and_its_disparities_are_widened() {
        let check = after(5, |place| place.vertical_px += 1.0);
        assert_eq!(check.faults(), [Fault::RowsApart]);
        assert!(check.widened(0.3) > 5.0, "{}", check.widened(0.3));
    }

    #[test]
    fn a_vergence_error_is_seen_against_terrain_even_with_a_height_error() {
        // 10 % too low all over is a height error; 0.9 px besides is vergence.
        let check = after(5, |place| {
            place.disparity_px = 0.9 * place.disparity_px + 0.9;
        });
        assert_eq!(check.faults(), [Fault::DisparityOff]);
        let height = after(5, |place| place.disparity_px *= 0.8);
        assert_eq!(height.faults(), []);
    }

    #[test]
    fn trees_on_the_ground_are_no_vergence_error() {
        let check = after(5, |place| {
            if (place.left.u * 10.0) as i32 % 4 == 0 {
                place.disparity_px *= 1.6;
            }
        });
        assert_eq!(check.faults(), []);
    }

    #[test]
    fn the_estimators_word_counts_beyond_its_own_sigma_only() {
        let mut check = after(5, |_| {});
        check.note_estimate(Some((0.9, 0.5)));
        assert_eq!(check.faults(), []);
        check.note_estimate(Some((0.9, 0.05)));
        assert_eq!(check.faults(), [Fault::ParallaxDisagrees]);
        check.note_estimate(None);
        assert_eq!(check.faults(), []);
    }

    #[test]
    fn blur_names_the_eye_and_widens() {
        let right = after(5, |place| place.sharpness = 1.9);
        assert_eq!(right.faults(), [Fault::RightBlurred]);
        assert!(right.widened(0.2) > 0.35);
        let left = after(5, |place| place.sharpness = 0.5);
        assert_eq!(left.faults(), [Fault::LeftBlurred]);
        let gain = after(5, |place| place.gain = 2.5);
        assert_eq!(gain.faults(), [Fault::GainApart]);
    }

    #[test]
    fn an_eye_that_sees_nothing_of_the_other_is_named() {
        let mut check = SelfCheck::new(0.1);
        for _ in 0..5 {
            let mut eyes = eyes(|_| {});
            eyes.found.truncate(4);
            check.note(&eyes, |_| None);
        }
        assert_eq!(check.faults(), [Fault::EyesUnlike]);
        assert!(check.widened(0.2) > 10.0);
    }

    #[test]
    fn a_fault_that_is_gone_is_taken_back_and_does_not_flap_at_its_limit() {
        let mut check = after(5, |place| place.vertical_px += 0.6);
        assert_eq!(check.faults(), [Fault::RowsApart]);
        let note = |check: &mut SelfCheck, rows: f64| {
            for _ in 0..WINDOW {
                check.note(&eyes(|place| place.vertical_px += rows), |_| None);
            }
        };
        note(&mut check, 0.45);
        assert_eq!(check.faults(), [Fault::RowsApart]);
        note(&mut check, 0.1);
        assert_eq!(check.faults(), []);
    }

    #[test]
    fn words_fit_a_status_text() {
        for fault in [
            Fault::RowsApart,
            Fault::DisparityOff,
            Fault::ParallaxDisagrees,
            Fault::LeftBlurred,
            Fault::RightBlurred,
            Fault::GainApart,
            Fault::EyesUnlike,
        ] {
            assert!(fault.words().len() <= 50, "{}", fault.words());
        }
    }
}
