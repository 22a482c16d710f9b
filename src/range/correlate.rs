//! Matching all pixels of a target as one: normalised correlation over the whole search, then least
//! squares below the pixel.

use super::error::{Factors, Matched, PLAIN, Signs};
use super::patch::Gray;
use super::refine::{LEAST_ALONG, Refined, Refiner};
use super::scene::{Mask, Run, Scene};
use super::search::{Curve, Peak, correlate};
use super::{Disparity, Miss, RangeConfig, Refusal};
use emberfix_calib::RectifiedPixel;

/// The flame and its outline: inside a saturated core nothing varies, at its rim everything does.
const OUTLINE_PX: usize = 2;
/// Below the pixel only the flame's own edge counts: the ground beside it lies at another disparity.
const RIM_PX: usize = 1;
/// How its error follows from what it saw.
const FACTORS: Factors = Factors {
    scatter: 0.16,
    dull: 4.0,
    astray: 4.3,
    hidden: 0.6,
    rise: 0.5,
    rise_astray: 2.4,
    ..PLAIN
};
/// The same between two spectra, where grey levels are unlike anyway: a third of it is the flame's doing.
const TWO_SPECTRA: Factors = Factors {
    scatter: 0.46,
    unlike_dull: 0.14,
    least_px: 0.022,
    ..PLAIN
};
/// Disagreement of the search there and back that is none.
const BACK_PX: i32 = 2;
/// A second peak counts as a rival when it leaves less than this share more unexplained.
const RIVAL: f64 = 1.35;
/// Peaks nearer to each other than this are one.
const SAME_PEAK_PX: i32 = 2;

pub(super) fn find(scene: &Scene<'_>, config: &RangeConfig) -> Result<Matched, Miss> {
    if scene.flame.count() < config.min_support as usize {
        return Err(Refusal::TooSmall.into());
    }
    let outlined = scene.compared(OUTLINE_PX).runs();
    let offsets = scene.search.offsets();
    let curve = correlate(&scene.left, &scene.right, &outlined, scene.every, offsets);
    let peak = rival_free(&curve, config.min_correlation, -scene.search.greatest)?;
    there_and_back(scene, &outlined, &peak)?;
    let right = scene.opposite(peak.at)?;
    let weights = scene.weights(RIM_PX);
    let left = scene.left_like(&right, peak.at)?;
    let refined = Refiner::new(&left, &right, &weights, -peak.at)
        .and_then(|refiner| refiner.refine(LEAST_ALONG))
        .ok_or(Refusal::Inconsistent)?;
    Ok(Matched {
        found: disparity(&scene.flame, &refined.found),
        likeness: likeness(&left, &right, &outlined, peak.at),
        signs: Signs {
            hidden: scene.hidden_share(),
            ..refined.signs
        },
        factors: if scene.two_spectra {
            &TWO_SPECTRA
        } else {
            &FACTORS
        },
    })
}

/// Correlation of what was compared, at one place.
fn likeness(left: &Gray, right: &Gray, runs: &[Run], at: i32) -> f64 {
    let curve = correlate(left, right, runs, 1, at..=at);
    curve.peaks().first().map_or(0.0, |peak| peak.correlation)
}

/// The best place in the right eye, if it is good enough and has no rival.
pub(super) fn rival_free(curve: &Curve, least: f64, nearest: i32) -> Result<Peak, Refusal> {
    let peaks = curve.peaks();
    let best = *peaks.first().ok_or(Refusal::Flat)?;
    if best.correlation < least {
        return Err(Refusal::NoPeak);
    }
    if best.at == nearest {
        return Err(Refusal::TooNear);
    }
    let rival = |peak: &&Peak| {
        (peak.at - best.at).abs() > SAME_PEAK_PX
            && 1.0 - peak.correlation < RIVAL * (1.0 - best.correlation)
    };
    match peaks.iter().skip(1).find(rival) {
        Some(_) => Err(Refusal::Ambiguous),
        None => Ok(best),
    }
}

/// What the right eye shows there must match best where it came from.
pub(super) fn there_and_back(scene: &Scene<'_>, runs: &[Run], peak: &Peak) -> Result<(), Miss> {
    let moved: Vec<Run> = runs
        .iter()
        .map(|run| Run {
            row: run.row,
            from: (run.from + peak.at).max(scene.right.area.left),
            to: (run.to + peak.at).min(scene.right.area.right),
        })
        .filter(|run| run.from < run.to)
        .collect();
    let back = scene.back(peak.at)?;
    let all = scene.search.all();
    let curve = correlate(&scene.right, &back, &moved, scene.every, all);
    match curve.peaks().first() {
        Some(found) if (found.at + peak.at).abs() <= BACK_PX => Ok(()),
        _ => Err(Refusal::OneSided.into()),
    }
}

/// A disparity with the flame that it is of; its sigma is the scatter.
pub(super) fn disparity(flame: &Mask, refined: &Refined) -> Disparity {
    Disparity {
        px: refined.disparity_px,
        sigma_px: refined.sigma_px,
        support: flame.count() as u32,
        centroid: RectifiedPixel {
            u: refined.at.0,
            v: refined.at.1,
        },
    }
}
