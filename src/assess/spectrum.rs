//! Light of sodium and potassium in a spectrum: what burning wood, straw and kerosene tell of
//! themselves through smoke and in any daylight.
//!
//! **In:** one reading of a `/spectrometer` stream: wavelengths in nm, intensities in any unit that is
//! proportional to light. **Out:** the light of the lines above what lies beside them, in the same
//! unit times nm. A near-infrared eye can stand in for it, best with a potassium filter: what stands out of
//! a box's surroundings in its picture (`pipeline`) is a sample of the same channel.

use emberfix_frames::ServiceTime;
use serde::Serialize;

/// One reading.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Spectrum {
    /// Mid-integration.
    pub at: ServiceTime,
    wavelengths_nm: Vec<f64>,
    intensity: Vec<f64>,
}

/// Every value was checked to be a number.
impl Eq for Spectrum {}

/// Why a reading is none.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum SpectrumError {
    /// Two lists that belong together and are not of one length, or none or too many values.
    #[error(
        "spectrum: {wavelengths} wavelengths and {intensities} intensities, allowed are 3 to {most} of each"
    )]
    Length {
        /// Of one list.
        wavelengths: usize,
        /// Of the other.
        intensities: usize,
        /// Greatest length.
        most: usize,
    },
    /// A value that is not finite, or wavelengths that do not rise.
    #[error(
        "spectrum: value {index} is {value}, allowed are finite intensities at rising wavelengths"
    )]
    Value {
        /// Where.
        index: usize,
        /// What stood there.
        value: f64,
    },
}

/// Values at most: spectrometers have some thousand.
const MOST_VALUES: usize = 16_384;

/// A line or a close pair of them.
struct Line {
    middle_nm: f64,
    /// Half width in which its light is, for an instrument of about 2 nm.
    half_nm: f64,
}

/// Sodium's pair at 589.0 and 589.6 nm; potassium's at 766.5 and 769.9 nm.
const LINES: [Line; 2] = [
    Line {
        middle_nm: 589.3,
        half_nm: 3.5,
    },
    Line {
        middle_nm: 768.2,
        half_nm: 5.0,
    },
];
/// The continuum is read beside the line: from 1.4 to 3 half widths.
const BESIDE: (f64, f64) = (1.4, 3.0);
/// Equal greatest values side by side, from which the detector is full.
const FULL: usize = 3;

impl Spectrum {
    /// Checks a reading.
    ///
    /// # Errors
    /// [`SpectrumError`].
    pub fn new(
        at: ServiceTime,
        wavelengths_nm: Vec<f64>,
        intensity: Vec<f64>,
    ) -> Result<Self, SpectrumError> {
        let length = wavelengths_nm.len();
        if length != intensity.len() || !(3..=MOST_VALUES).contains(&length) {
            return Err(SpectrumError::Length {
                wavelengths: length,
                intensities: intensity.len(),
                most: MOST_VALUES,
            });
        }
        let mut last = 0.0;
        for (index, (wavelength, value)) in wavelengths_nm.iter().zip(&intensity).enumerate() {
            let rises = wavelength.is_finite() && *wavelength > last;
            if !rises || !value.is_finite() {
                let value = if rises { *value } else { *wavelength };
                return Err(SpectrumError::Value { index, value });
            }
            last = *wavelength;
        }
        Ok(Self {
            at,
            wavelengths_nm,
            intensity,
        })
    }

    /// Wavelengths, nm, rising.
    #[must_use]
    pub fn wavelengths_nm(&self) -> &[f64] {
        &self.wavelengths_nm
    }

    /// Intensities, in the instrument's unit.
    #[must_use]
    pub fn intensity(&self) -> &[f64] {
        &self.intensity
    }

    /// Light of the lines above their continuum, not below zero. `None` when the instrument sees
    /// none of the lines, or is full at one.
    #[must_use]
    pub fn line_light(&self) -> Option<f64> {
        let lights: Vec<Option<f64>> = LINES
            .iter()
            .filter_map(|line| self.light_of(line))
            .collect();
        if lights.is_empty() {
            return None;
        }
        lights.into_iter().sum()
    }

    /// Outer `None`: the line is not covered; inner: the detector is full there.
    fn light_of(&self, line: &Line) -> Option<Option<f64>> {
        let mean_in = |low: f64, high: f64| {
            let inside = self.between(
                line.middle_nm + low * line.half_nm,
                line.middle_nm + high * line.half_nm,
            );
            (!inside.is_empty()).then(|| inside.iter().sum::<f64>() / inside.len() as f64)
        };
        let below = mean_in(-BESIDE.1, -BESIDE.0)?;
        let above = mean_in(BESIDE.0, BESIDE.1)?;
        let own = mean_in(-1.0, 1.0)?;
        let at_line = self.between(line.middle_nm - line.half_nm, line.middle_nm + line.half_nm);
        if is_full(at_line) {
            return Some(None);
        }
        let light = (own - (below + above) / 2.0) * 2.0 * line.half_nm;
        Some(Some(light.max(0.0)))
    }

    fn between(&self, low_nm: f64, high_nm: f64) -> &[f64] {
        let from = self.wavelengths_nm.partition_point(|nm| *nm < low_nm);
        let to = self.wavelengths_nm.partition_point(|nm| *nm <= high_nm);
        &self.intensity[from..to]
    }
}

fn is_full(values: &[f64]) -> bool {
    let greatest = values.iter().copied().fold(f64::MIN, f64::max);
    let full = |window: &[f64]| greatest > 0.0 && window.iter().all(|value| *value == greatest);
    values.windows(FULL).any(full)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sloping continuum with both lines on it.
    fn reading(strength: f64, slope: f64) -> Spectrum {
        let wavelengths: Vec<f64> = (0..1200).map(|k| 400.0 + 0.4 * f64::from(k)).collect();
        let line = |nm: f64, at: f64| (-(nm - at).powi(2) / 2.0).exp();
        let intensity = wavelengths.iter().map(|nm| {
            let lines = line(*nm, 589.3) + line(*nm, 766.5) + line(*nm, 769.9);
            10.0 + slope * (nm - 400.0) + strength * lines
        });
        let intensity = intensity.collect();
        Spectrum::new(ServiceTime::from_unix_ns(0), wavelengths, intensity).unwrap()
    }

    #[test]
    fn the_lines_count_and_the_continuum_does_not() {
        let alone = reading(5.0, 0.0).line_light().unwrap();
        // Three lines of height 5 and one sigma of 1 nm: 3 * 5 * sqrt(2 pi).
        assert!((alone / 37.6 - 1.0).abs() < 0.05, "{alone}");
        let in_daylight = reading(5.0, 0.3).line_light().unwrap();
        assert!((in_daylight / alone - 1.0).abs() < 0.01, "{in_daylight}");
        assert!(reading(0.0, 0.3).line_light().unwrap() < 0.02 * alone);
    }

    #[test]
    fn a_full_detector_and_one_that_sees_no_line_give_no_sample() {
        let full = reading(5.0, 0.0);
        let clipped = full.intensity.iter().map(|value| value.min(11.0)).collect();
        let clipped = Spectrum::new(full.at, full.wavelengths_nm.clone(), clipped).unwrap();
        assert_eq!(clipped.line_light(), None);
        let blue = (0..100).map(|k| 400.0 + f64::from(k)).collect();
        let blue = Spectrum::new(full.at, blue, vec![1.0; 100]).unwrap();
        assert_eq!(blue.line_light(), None);
    }

    #[test]
    fn what_is_no_spectrum_is_refused() {
        let at = ServiceTime::from_unix_ns(0);
        assert!(Spectrum::new(at, vec![1.0, 2.0], vec![1.0, 2.0]).is_err());
        assert!(Spectrum::new(at, vec![1.0, 2.0, 3.0], vec![1.0, 2.0]).is_err());
        assert!(Spectrum::new(at, vec![1.0, 3.0, 2.0], vec![1.0; 3]).is_err());
        assert!(Spectrum::new(at, vec![1.0, 2.0, 3.0], vec![1.0, f64::NAN, 1.0]).is_err());
    }
}
