//! What known distances say of a rig: `1 / measured = scale / true + offset`.
//!
//! A baseline or focal length that is wrong by a factor shows as the scale, a constant disparity error
//! as the offset; P1's readings, which are always too far, are both (checklist E13).

use nalgebra::{DMatrix, DVector, Dyn, Matrix2, MatrixXx2, Vector2, linalg::Cholesky};

/// Scale and offset of inverse depth, with their covariance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InverseDepth {
    /// Of 1 / measured against 1 / true.
    pub scale: f64,
    /// 1 / measured at infinity, 1/m.
    pub offset_per_m: f64,
    /// Variance of the scale, covariance, variance of the offset (1/m²).
    pub covariance: [f64; 3],
}

/// A known distance and what the rig made of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    /// True depth along the boresight, metres.
    pub true_m: f64,
    /// Measured depth, metres.
    pub measured_m: f64,
}

/// Distances that are themselves estimates, and what the rig made of them, in 1/m.
#[derive(Debug, Clone)]
pub struct Sightings {
    /// Inverse depths along the boresight, by all but stereo.
    pub per_m: DVector<f64>,
    /// Their covariance: estimates of one flight are wrong together.
    pub covariance: DMatrix<f64>,
    /// Measured inverse depths, without a correction.
    pub measured_per_m: DVector<f64>,
    /// One sigma of each by itself.
    pub sigma_per_m: DVector<f64>,
    /// One sigma of what is the same in every picture of one flame from like distances (what shows through it
    /// and beside it, light from before its axis), 1/m.
    pub alike_per_m: f64,
}

/// Why readings make no correction.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum InverseDepthError {
    /// A straight line and its error need three.
    #[error("{found} readings, needed are at least {needed} at different distances")]
    TooFew {
        /// How many came.
        found: usize,
        /// How many it takes.
        needed: usize,
    },
    /// No distance.
    #[error("reading {number} has {true_m} m for {measured_m} m, needed are positive numbers")]
    NoDistance {
        /// Which, from 1.
        number: usize,
        /// Metres.
        true_m: f64,
        /// Metres.
        measured_m: f64,
    },
    /// One distance can't tell a scale from an offset.
    #[error(
        "true distances reach from {nearest_m} to {farthest_m} m, needed is a factor of {factor}"
    )]
    TooAlike {
        /// Metres.
        nearest_m: f64,
        /// Metres.
        farthest_m: f64,
        /// Least ratio of the two.
        factor: f64,
    },
    /// No rig is that wrong.
    #[error(
        "{what} would be {value:.4}, allowed is {least} to {most}: are both columns metres along the \
         boresight, true before measured?"
    )]
    Implausible {
        /// Scale or offset.
        what: &'static str,
        /// Its value.
        value: f64,
        /// Allowed from.
        least: f64,
        /// Allowed to.
        most: f64,
    },
    /// The distances are not known well enough.
    #[error(
        "the correction would be known to {percent:.1} % only, allowed is {limit} %: pass the fire nearer, on \
         more sides, with a better position (RTK), or give the fire's surveyed place"
    )]
    Unsure {
        /// One sigma of a corrected distance, of the distance.
        percent: f64,
        /// Percent.
        limit: f64,
    },
    /// A line does not describe them.
    #[error(
        "reading {number} ({true_m} m) is {percent:.1} % off even when corrected, allowed is {limit} %"
    )]
    Scattered {
        /// Which, from 1.
        number: usize,
        /// Metres.
        true_m: f64,
        /// Of the true distance.
        percent: f64,
        /// Percent.
        limit: f64,
    },
}

const FEWEST: usize = 3;
const LEAST_FACTOR: f64 = 1.5;
/// Scales beyond these are swapped columns or wrong units.
pub(crate) const SCALES: (f64, f64) = (0.7, 1.4);
/// Offsets beyond these would put infinity within ten metres.
pub(crate) const OFFSETS_PER_M: (f64, f64) = (-0.1, 0.1);
const WORST_PERCENT: f64 = 15.0;
/// Largest sigma of the distance in the middle of those that were flown, of the distance.
const UNSURE_PERCENT: f64 = 3.0;
/// Distances that are apart by this factor share `1/e` of what is alike.
const ALIKE_FACTOR: f64 = 1.5;
/// Sigmas beyond which a measured distance is another fire's or none.
const STRAY: f64 = 5.0;
/// Rounds in which the scale weighs the distances' own errors anew.
const ROUNDS: usize = 3;

impl Default for InverseDepth {
    /// A rig that nothing is known against.
    fn default() -> Self {
        Self {
            scale: 1.0,
            offset_per_m: 0.0,
            covariance: [0.0; 3],
        }
    }
}

impl InverseDepth {
    /// Least squares over readings, each with the same relative error.
    ///
    /// # Errors
    /// [`InverseDepthError`]: too few, too alike, or not the readings of a stereo rig.
    pub fn fit(readings: &[Reading]) -> Result<Self, InverseDepthError> {
        check(readings)?;
        let (mut sw, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for reading in readings {
            let (x, y) = (1.0 / reading.true_m, 1.0 / reading.measured_m);
            let weight = reading.measured_m.powi(2);
            sw += weight;
            sx += weight * x;
            sy += weight * y;
            sxx += weight * x * x;
            sxy += weight * x * y;
        }
        let determinant = sw * sxx - sx * sx;
        let scale = (sw * sxy - sx * sy) / determinant;
        let offset_per_m = (sy - scale * sx) / sw;
        let squares: f64 = readings
            .iter()
            .map(|reading| {
                let predicted = scale / reading.true_m + offset_per_m;
                (reading.measured_m * predicted - 1.0).powi(2)
            })
            .sum();
        let variance = squares / (readings.len() - 2) as f64;
        let fitted = Self {
            scale,
            offset_per_m,
            covariance: [sw, -sx, sxx].map(|term| variance * term / determinant),
        };
        fitted.check(readings)?;
        Ok(fitted)
    }

    /// Generalised least squares over sightings whose distances are estimates: their covariance, and what the
    /// pictures of one flame have in common, are not averaged away. What makes every flame look too far or too
    /// near is corrected with the rig's own part, for it is the same to whoever measures with both.
    ///
    /// # Errors
    /// [`InverseDepthError`]: too few, too alike, not known well enough, or not those of a stereo rig.
    pub fn fit_sightings(sightings: &Sightings) -> Result<Self, InverseDepthError> {
        let sightings = sightings.without_strays();
        check(&sightings.readings())?;
        let mut fitted = Self::default();
        for _ in 0..ROUNDS {
            fitted = sightings
                .weigh(fitted.scale)
                .ok_or(InverseDepthError::Unsure {
                    percent: f64::INFINITY,
                    limit: UNSURE_PERCENT,
                })?;
        }
        fitted.check(&[])?;
        let (least, most) = (sightings.per_m.min(), sightings.per_m.max());
        let middle_per_m = (least * most).sqrt();
        let percent = 100.0 * fitted.sigma_per_m(middle_per_m) / middle_per_m;
        if percent > UNSURE_PERCENT {
            return Err(InverseDepthError::Unsure {
                percent,
                limit: UNSURE_PERCENT,
            });
        }
        Ok(fitted)
    }

    fn check(&self, readings: &[Reading]) -> Result<(), InverseDepthError> {
        let bounds = [
            ("the scale", self.scale, SCALES),
            ("the offset in 1/m", self.offset_per_m, OFFSETS_PER_M),
        ];
        for (what, value, (least, most)) in bounds {
            if !(least..=most).contains(&value) {
                return Err(InverseDepthError::Implausible {
                    what,
                    value,
                    least,
                    most,
                });
            }
        }
        for (number, reading) in (1..).zip(readings) {
            let corrected_m = 1.0 / self.corrected_per_m(1.0 / reading.measured_m);
            let percent = 100.0 * (corrected_m / reading.true_m - 1.0).abs();
            // NaN is no better than too much.
            if percent.is_nan() || percent > WORST_PERCENT {
                return Err(InverseDepthError::Scattered {
                    number,
                    true_m: reading.true_m,
                    percent,
                    limit: WORST_PERCENT,
                });
            }
        }
        Ok(())
    }

    /// True inverse depth of a measured one, both 1/m.
    #[must_use]
    pub fn corrected_per_m(&self, measured_per_m: f64) -> f64 {
        (measured_per_m - self.offset_per_m) / self.scale
    }

    /// The other way round: what is measured of a true inverse depth, both 1/m.
    #[must_use]
    pub fn measured_per_m(&self, true_per_m: f64) -> f64 {
        self.scale * true_per_m + self.offset_per_m
    }

    /// One sigma that the correction itself leaves in a corrected inverse depth, 1/m.
    #[must_use]
    pub fn sigma_per_m(&self, corrected_per_m: f64) -> f64 {
        let [scale, both, offset] = self.covariance;
        let x = corrected_per_m;
        ((scale * x * x + 2.0 * both * x + offset).max(0.0)).sqrt() / self.scale
    }

    /// The lines of a rig file that hold it.
    fn lines(&self) -> String {
        let [scale, both, offset] = self.covariance;
        format!(
            "{HEAD}\nscale = {:.7}\noffset_per_m = {:.8}\ncovariance = [{scale:.3e}, {both:.3e}, {offset:.3e}]\n",
            self.scale, self.offset_per_m
        )
    }

    /// A rig file's text with this correction instead of the one that it has, if it has one. Everything
    /// else stays as it is, comments too.
    #[must_use]
    pub fn written_into(&self, rig_text: &str) -> String {
        let mut kept = String::new();
        let mut ours = false;
        for line in rig_text.lines() {
            if line.trim_start().starts_with('[') {
                ours = line.trim() == HEAD;
            }
            if !ours {
                kept.push_str(line);
                kept.push('\n');
            }
        }
        format!("{}\n\n{}", kept.trim_end(), self.lines())
    }
}

impl Sightings {
    /// As known distances, for a table.
    #[must_use]
    pub fn readings(&self) -> Vec<Reading> {
        let pairs = self.per_m.iter().zip(&self.measured_per_m);
        pairs
            .map(|(per_m, measured_per_m)| Reading {
                true_m: 1.0 / per_m,
                measured_m: 1.0 / measured_per_m,
            })
            .collect()
    }

    /// Those whose ratio of measured to known is within five sigmas (by the median deviation, and not less
    /// than what they claim) of the median ratio.
    #[must_use]
    pub fn without_strays(&self) -> Self {
        let ratios = self.measured_per_m.component_div(&self.per_m);
        let middle = median(ratios.iter().copied());
        let spread = 1.4826 * median(ratios.iter().map(|ratio| (ratio - middle).abs()));
        let kept: Vec<usize> = (0..ratios.len())
            .filter(|&k| {
                let claimed = self.sigma_per_m[k] / self.per_m[k];
                (ratios[k] - middle).abs() <= STRAY * spread.max(claimed)
            })
            .collect();
        Self {
            per_m: self.per_m.select_rows(&kept),
            covariance: self.covariance.select_rows(&kept).select_columns(&kept),
            measured_per_m: self.measured_per_m.select_rows(&kept),
            sigma_per_m: self.sigma_per_m.select_rows(&kept),
            alike_per_m: self.alike_per_m,
        }
    }

    /// Scale and offset when the distances' errors enter by `scale`; `None` where they are no information.
    fn weigh(&self, scale: f64) -> Option<InverseDepth> {
        let count = self.per_m.len();
        let alike = DMatrix::from_fn(count, count, |one, other| {
            let apart = (self.per_m[one] / self.per_m[other]).ln().abs();
            self.alike_per_m.powi(2) * (-apart / ALIKE_FACTOR.ln()).exp()
        });
        let own = self.sigma_per_m.component_mul(&self.sigma_per_m);
        let covariance = &self.covariance * (scale * scale) + DMatrix::from_diagonal(&own) + alike;
        let weights: Cholesky<f64, Dyn> = covariance.cholesky()?;
        let ones = DVector::from_element(self.per_m.len(), 1.0);
        let line = MatrixXx2::from_columns(&[self.per_m.clone(), ones]);
        let weighted = weights.solve(&line);
        let inverse: Matrix2<f64> = (line.transpose() * &weighted).try_inverse()?;
        let found: Vector2<f64> = inverse * (weighted.transpose() * &self.measured_per_m);
        // Where the line leaves more than was claimed, as much more is owned up to (Birge's ratio).
        let left = &self.measured_per_m - &line * found;
        let freedom = self.per_m.len().saturating_sub(2).max(1) as f64;
        let widened = (left.dot(&weights.solve(&left)) / freedom).max(1.0);
        let covariance = inverse * widened;
        Some(InverseDepth {
            scale: found.x,
            offset_per_m: found.y,
            covariance: [covariance.m11, covariance.m12, covariance.m22],
        })
    }
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

const HEAD: &str = "[inverse_depth]";

fn check(readings: &[Reading]) -> Result<(), InverseDepthError> {
    let positive = |value: f64| value.is_finite() && value > 0.0;
    for (number, reading) in (1..).zip(readings) {
        if !(positive(reading.true_m) && positive(reading.measured_m)) {
            return Err(InverseDepthError::NoDistance {
                number,
                true_m: reading.true_m,
                measured_m: reading.measured_m,
            });
        }
    }
    if readings.len() < FEWEST {
        return Err(InverseDepthError::TooFew {
            found: readings.len(),
            needed: FEWEST,
        });
    }
    let distances = || readings.iter().map(|reading| reading.true_m);
    let nearest_m = distances().fold(f64::INFINITY, f64::min);
    let farthest_m = distances().fold(0.0, f64::max);
    if farthest_m < LEAST_FACTOR * nearest_m {
        return Err(InverseDepthError::TooAlike {
            nearest_m,
            farthest_m,
            factor: LEAST_FACTOR,
        });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// P1, table IV: true and mean measured, metres.
    const P1: [(f64, f64); 6] = [
        (0.5, 0.5108),
        (1.0, 1.0206),
        (2.0, 2.0440),
        (3.0, 3.0905),
        (5.0, 5.2073),
        (10.0, 10.787),
    ];

    fn readings(pairs: &[(f64, f64)]) -> Vec<Reading> {
        pairs
            .iter()
            .map(|&(true_m, measured_m)| Reading { true_m, measured_m })
            .collect()
    }

    /// Checklist E13: printed 2 to 8 % too far, all of it two constants.
    #[test]
    fn p1s_printed_readings_come_within_half_a_percent() {
        let fit = InverseDepth::fit(&readings(&P1)).unwrap();
        assert!((fit.scale - 0.98642).abs() < 1e-5, "{fit:?}");
        assert!((fit.offset_per_m + 5.744e-3).abs() < 1e-6, "{fit:?}");
        for (true_m, measured_m) in P1 {
            let corrected_m = 1.0 / fit.corrected_per_m(1.0 / measured_m);
            let percent = 100.0 * (corrected_m / true_m - 1.0);
            assert!(percent.abs() <= 0.5, "{true_m} m: {percent} %");
        }
    }

    #[test]
    fn the_covariance_covers_what_is_left() {
        let fit = InverseDepth::fit(&readings(&P1)).unwrap();
        for (true_m, measured_m) in P1 {
            let corrected = fit.corrected_per_m(1.0 / measured_m);
            let off = (corrected - 1.0 / true_m).abs();
            let relative = fit.sigma_per_m(corrected) * true_m;
            assert!(relative < 0.01, "{true_m} m: {relative}");
            assert!(
                off * true_m < 4.0 * relative,
                "{true_m} m: {off} {relative}"
            );
        }
    }

    /// Sightings from 8 to 30 m of a rig whose baseline is taken 6 % too long, and whose distances are all
    /// wrong by one factor, of sigma `alike`.
    fn flown(seed: f64, alike: f64) -> (Sightings, f64) {
        // Deviates of sigma 1 that need no generator: fractions of the golden ratio's multiples.
        let deviate = |k: f64| ((k * 0.618_034 + seed * 0.414_214).fract() - 0.5) * 12_f64.sqrt();
        let truth = DVector::from_fn(60, |k, _| 1.0 / (8.0 + 22.0 * k as f64 / 59.0));
        let factor = alike * deviate(seed * 7.0 + 3.0);
        let sigma_per_m = DVector::from_element(60, 0.001);
        let measured_per_m =
            DVector::from_fn(60, |k, _| truth[k] / 1.06 + 0.001 * deviate(k as f64));
        let sightings = Sightings {
            per_m: &truth * (1.0 + factor),
            covariance: &truth * truth.transpose() * (alike * alike),
            measured_per_m,
            sigma_per_m,
            alike_per_m: 0.0005,
        };
        (sightings, factor)
    }

    #[test]
    fn a_wrong_baseline_is_found_from_estimated_distances_with_an_honest_sigma() {
        for seed in 0..20 {
            let (sightings, _) = flown(f64::from(seed), 0.01);
            let fit = InverseDepth::fit_sightings(&sightings).unwrap();
            let sigma = fit.covariance[0].sqrt();
            let off = fit.scale - 1.0 / 1.06;
            // What is wrong with all distances alike stays in the sigma however many there are.
            assert!(sigma > 0.009, "{sigma}");
            assert!(off.abs() < 3.0 * sigma, "{off} {sigma}");
        }
    }

    #[test]
    fn distances_that_are_hardly_known_make_no_correction() {
        let (sightings, _) = flown(1.0, 0.05);
        let refused = InverseDepth::fit_sightings(&sightings).unwrap_err();
        assert!(refused.to_string().contains("RTK"), "{refused}");
    }

    #[test]
    fn a_match_that_is_far_too_near_is_left_out() {
        let (mut sightings, _) = flown(2.0, 0.01);
        let clean = InverseDepth::fit_sightings(&sightings).unwrap();
        sightings.measured_per_m[30] *= 3.0;
        let fit = InverseDepth::fit_sightings(&sightings).unwrap();
        assert!((fit.scale - clean.scale).abs() < 0.002, "{fit:?} {clean:?}");
    }

    #[test]
    fn nonsense_is_refused_in_one_line() {
        for (pairs, says) in [
            (&[(1.0, 1.0), (2.0, 2.0)][..], "2 readings"),
            (&[(1.0, 1.0), (2.0, -2.0), (3.0, 3.0)], "reading 2 has"),
            (&[(1.0, 1.0), (2.0, f64::NAN), (3.0, 3.0)], "reading 2 has"),
            (&[(2.0, 2.0), (2.1, 2.1), (2.2, 2.2)], "factor of 1.5"),
            (
                &[(1.0, 1000.0), (2.0, 2000.0), (3.0, 3000.0)],
                "the scale would be 0.0010",
            ),
            (
                &[(1.0, 1.0), (2.0, 2.0), (3.0, 3.9), (4.0, 4.0)],
                "even when corrected",
            ),
        ] {
            let message = InverseDepth::fit(&readings(pairs)).unwrap_err().to_string();
            assert!(
                message.contains(says) && !message.contains('\n'),
                "{message}"
            );
        }
    }

    #[test]
    fn writing_twice_leaves_one_table_and_all_comments() {
        let fit = InverseDepth::fit(&readings(&P1)).unwrap();
        let text = "# a rig\nname = \"x\"\n\n[sigma]\nboresight_deg = 0.1 # known\n";
        let once = fit.written_into(text);
        assert!(once.starts_with(text.trim_end()), "{once}");
        assert_eq!(fit.written_into(&once), once);
        assert_eq!(once.matches(HEAD).count(), 1);
    }
}
