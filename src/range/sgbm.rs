//! Semi-global matching per pixel in the padded box, pooled under the flame's mask (P3, P4).

use super::error::{Factors, Matched, PLAIN, Signs};
use super::patch::Gray;
use super::pool::{Pooled, Sample, pool};
use super::refine::{LEAST_ALONG, Refinement, Refiner};
use super::scene::{Mask, Scene, Search};
use super::search::correlate;
use super::{Disparity, Miss, RangeConfig, RangeError, Refusal};
use emberfix_calib::RectifiedPixel;
use opencv::calib3d::{StereoSGBM, StereoSGBM_MODE_SGBM};
use opencv::core::{Mat, MatTraitConst, Ptr};
use opencv::prelude::StereoMatcherTrait;

/// OpenCV's matcher and how its disparities are pooled.
pub(super) struct SemiGlobal {
    matcher: Ptr<StereoSGBM>,
    search: Search,
    config: RangeConfig,
}

impl SemiGlobal {
    pub fn new(search: Search, config: &RangeConfig) -> Result<Self, RangeError> {
        Ok(Self {
            matcher: matcher(config, search.least)?,
            search,
            config: config.clone(),
        })
    }

    pub fn find(&mut self, scene: &Scene<'_>) -> Result<Matched, Miss> {
        if scene.cutter.two_spectra() {
            return Err(Refusal::OtherSpectrum.into());
        }
        let samples = self.samples(scene)?;
        let covered = samples.len() as f64 / scene.compared(0).count().max(1) as f64;
        if covered < LEAST_COVERED {
            return Err(Refusal::Inconsistent.into());
        }
        let pooled = pool(&samples).ok_or(Refusal::NoPeak)?;
        let config = &self.config;
        if pooled.support < config.min_support {
            return Err(Refusal::TooSmall.into());
        }
        if pooled.agreement < config.min_agreement {
            return Err(Refusal::Inconsistent.into());
        }
        let likeness = borne_out(scene, &samples, &pooled, config)?;
        let beside = least_squares(scene, pooled.disparity_px)?;
        if beside.signs.dullness * (1.0 - likeness) > MOST_UNLIKE {
            return Err(Refusal::NoPeak.into());
        }
        let found = Disparity {
            px: pooled.disparity_px,
            sigma_px: UNSETTLED_PX * (1.0 - pooled.agreement).powi(2),
            support: pooled.support,
            centroid: RectifiedPixel {
                u: pooled.centroid.0,
                v: pooled.centroid.1,
            },
        };
        Ok(Matched {
            found,
            likeness: 1.0,
            signs: Signs {
                hidden: scene.hidden_share(),
                split_px: (beside.found.disparity_px - pooled.disparity_px).abs(),
                ..Signs::default()
            },
            factors: &FACTORS,
        })
    }

    /// Every valid disparity under the mask.
    fn samples(&mut self, scene: &Scene<'_>) -> Result<Vec<Sample>, RangeError> {
        let strip = scene.search.strip(&scene.context);
        let left = scene.cutter.left_gray(scene.left_bgr, strip)?;
        let right = scene.cutter.right(scene.right_gray, strip)?;
        let mut disparities = Mat::default();
        self.matcher
            .compute(&bytes(&left)?, &bytes(&right)?, &mut disparities)?;
        let invalid = (self.search.least - 1) * 16;
        let seen = f64::from(scene.right.seen.0)..f64::from(scene.right.seen.1);
        let mut samples = Vec::new();
        for (column, row) in pixels(&scene.compared(0)) {
            let at = (row - strip.top, column - strip.left);
            let sixteenths = i32::from(*disparities.at_2d::<i16>(at.0, at.1)?);
            let disparity_px = f64::from(sixteenths) / 16.0;
            if sixteenths > invalid && seen.contains(&(f64::from(column) - disparity_px)) {
                samples.push(Sample {
                    at: (column, row),
                    disparity_px,
                });
            }
        }
        Ok(samples)
    }
}

/// Pixels of error, one sigma, if no two pixels agreed. Neighbours share their errors, so that the spread
/// of those that agree says little; how many do not agree says more.
const UNSETTLED_PX: f64 = 6.3;
/// How its error follows from that. Whole pixels pull at its disparities, whatever agrees: least squares at the same
/// place, which they do not pull at, shows by how much.
const FACTORS: Factors = Factors {
    scatter: 0.8,
    split: 0.8,
    hidden_px: 0.17,
    least_px: 0.05,
    ..PLAIN
};
/// Below the pixel only the flame's own edge counts.
const RIM_PX: usize = 1;
/// Share of the flame that must have a valid disparity: where less has, the eyes show it differently.
const LEAST_COVERED: f64 = 0.5;
/// Least correlation of what was matched: no gain or offset is made up for pixel by pixel.
const LEAST_LIKENESS: f64 = 0.8;

/// Most that dullness of one eye and what is missing to full likeness may multiply to: through a dirty lens light is
/// not to be compared as it is. Of plain flames in the tuning set of `emberfix eval range` hardly any exceeds it, of
/// those that a dirty eye sees two in five.
const MOST_UNLIKE: f64 = 0.07;

/// How well the target as a whole bears a disparity out; one that it does not is a phantom.
fn borne_out(
    scene: &Scene<'_>,
    samples: &[Sample],
    pooled: &Pooled,
    config: &RangeConfig,
) -> Result<f64, Refusal> {
    let mut matched = Mask {
        kept: vec![false; scene.flame.kept.len()],
        ..scene.flame.clone()
    };
    let area = matched.area;
    for Sample {
        at: (column, row), ..
    } in samples
    {
        let index = (row - area.top) as usize * area.width() + (column - area.left) as usize;
        matched.kept[index] = true;
    }
    let middle = -pooled.disparity_px.round() as i32;
    let offsets = (middle - 2).max(-scene.search.greatest)..=(middle + 2).min(-scene.search.least);
    let runs = matched.runs();
    let curve = correlate(&scene.left, &scene.right, &runs, scene.every, offsets);
    let best = curve.values.into_iter().fold(f64::NAN, f64::max);
    if best >= LEAST_LIKENESS.max(config.min_correlation) {
        Ok(best)
    } else {
        Err(Refusal::NoPeak)
    }
}

/// The disparity of the target as one about the matched one; where its parts do not go with it, the match is of
/// something else.
fn least_squares(scene: &Scene<'_>, disparity_px: f64) -> Result<Refinement, Miss> {
    let start_px = disparity_px.round() as i32;
    let right = scene.opposite(-start_px)?;
    let left = scene.left_like(&right, -start_px)?;
    let refined = Refiner::new(&left, &right, &scene.weights(RIM_PX), start_px)
        .and_then(|refiner| refiner.refine(LEAST_ALONG));
    Ok(refined.ok_or(Refusal::Inconsistent)?)
}

/// Columns and rows of a mask's pixels.
fn pixels(mask: &Mask) -> impl Iterator<Item = (i32, i32)> + '_ {
    mask.runs()
        .into_iter()
        .flat_map(|run| (run.from..run.to).map(move |column| (column, run.row)))
}

fn bytes(gray: &Gray) -> opencv::Result<Mat> {
    let values: Vec<u8> = gray.values.iter().map(|v| (v + 0.5) as u8).collect();
    let rows = gray.area.height() as i32;
    Mat::from_slice(&values)?.reshape(1, rows)?.try_clone()
}

fn matcher(config: &RangeConfig, least: i32) -> opencv::Result<Ptr<StereoSGBM>> {
    let block = config.block_px as i32;
    StereoSGBM::create(
        least,
        config.num_disparities as i32,
        block,
        // Penalties for a change of one and of more, as OpenCV's authors scale them.
        8 * block * block,
        32 * block * block,
        config.left_right_max_px as i32,
        config.pre_filter_cap as i32,
        config.uniqueness_percent as i32,
        config.speckle_window_px as i32,
        2,
        StereoSGBM_MODE_SGBM,
    )
}

/// Mean error of the matcher's valid disparities against a truth image in `1 / scale` pixels (0 is
/// unknown), and the share of the known pixels that have a value.
#[cfg(test)]
pub(super) fn mean_error_px(
    config: &RangeConfig,
    left: &Mat,
    right: &Mat,
    truth: &Mat,
    scale: f64,
) -> opencv::Result<(f64, f64)> {
    use opencv::prelude::MatTraitConstManual;
    let mut disparities = Mat::default();
    matcher(config, 0)?.compute(left, right, &mut disparities)?;
    let (mut sum, mut valid, mut known) = (0.0, 0.0, 0.0);
    for row in 0..truth.rows() {
        for (want, got) in truth
            .at_row::<u8>(row)?
            .iter()
            .zip(disparities.at_row::<i16>(row)?)
        {
            known += f64::from(u8::from(*want > 0));
            if *want > 0 && *got >= 0 {
                sum += (f64::from(*got) / 16.0 - f64::from(*want) / scale).abs();
                valid += 1.0;
            }
        }
    }
    Ok((sum / valid, valid / known))
}
