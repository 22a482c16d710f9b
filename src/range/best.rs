//! All methods that apply, weighed by what each says of its own error; contradiction is refusal.

use super::error::{Matched, Sigma};
use super::scene::Scene;
use super::{
    Disparity, Method, Methods, Miss, RangeConfig, Refusal, centroid, correlate, cross_spectral,
};
use emberfix_calib::RectifiedPixel;

/// What one method said.
type Said = (Method, Result<Voice, Refusal>);

/// One method's disparity.
#[derive(Debug, Clone, Copy)]
struct Voice {
    method: Method,
    found: Disparity,
    sigma: Sigma,
    likeness: f64,
}

/// Disparities agree when they differ by less than this many sigmas of what is their own.
const AGREE_SIGMAS: f64 = 3.0;
/// Correlation of the methods' own errors: they look at the same pixels, each in its own way. On rendered
/// flames (the tuning set of `emberfix eval range`) it is 0.27 between correlation and centroids, and less
/// between either and features.
const ALIKE: f64 = 0.25;
/// Chi-square for each voice beyond the first that chance still explains: one time in six it is greater.
const BY_CHANCE: f64 = 2.0;
/// A single voice that is not sure is believed this much less.
const ALONE: f64 = 2.0;
/// A correlation above this needs no other voice, unless one contradicts.
const SURE: f64 = 0.9;

/// Correlation and centroids; where they leave doubt the features that survive a change of spectrum
/// decide.
pub(super) fn find(scene: &Scene<'_>, config: &RangeConfig) -> Result<(Disparity, Methods), Miss> {
    let mut said = vec![
        voice(scene, Method::Correlate, correlate::find(scene, config))?,
        voice(scene, Method::Centroid, centroid::find(scene, config))?,
    ];
    let sure = said[0].1.is_ok_and(|voice| voice.likeness > SURE);
    let settled = match (&said[0].1, &said[1].1) {
        (Ok(a), Ok(b)) => a.agrees(b),
        (Ok(_), Err(why)) => sure && !warns(*why),
        (Err(_), _) => false,
    };
    if !settled {
        let third = cross_spectral::find(scene, config);
        said.push(voice(scene, Method::CrossSpectral, third)?);
    }
    Ok(decide(&said, if sure { 1.0 } else { ALONE })?)
}

/// Whether a refusal speaks against every other method's answer.
fn warns(why: Refusal) -> bool {
    matches!(
        why,
        Refusal::Ambiguous | Refusal::OneSided | Refusal::TooNear
    )
}

/// A failure is passed on, a refusal is one voice less.
fn voice(scene: &Scene<'_>, method: Method, said: Result<Matched, Miss>) -> Result<Said, Miss> {
    match said {
        Ok(matched) => {
            let voice = Voice {
                method,
                found: matched.found,
                sigma: scene.sigma(&matched),
                likeness: matched.likeness,
            };
            Ok((method, Ok(voice)))
        }
        Err(Miss::Refused(why)) => Ok((method, Err(why))),
        Err(failed) => Err(failed),
    }
}

impl Voice {
    /// What all methods see alike does not set them apart.
    fn agrees(&self, other: &Self) -> bool {
        let apart_px = (self.found.px - other.found.px).abs();
        apart_px < AGREE_SIGMAS * self.sigma.own_px.hypot(other.sigma.own_px)
    }

    fn weight(&self) -> f64 {
        self.sigma.own_px.powi(-2)
    }
}

fn decide(said: &[Said], alone: f64) -> Result<(Disparity, Methods), Refusal> {
    let voices: Vec<Voice> = said.iter().filter_map(|(_, said)| said.ok()).collect();
    let groups = voices.iter().map(|one| -> Vec<Voice> {
        let agreeing = voices.iter().filter(|other| one.agrees(other));
        agreeing.copied().collect()
    });
    let largest = groups.max_by_key(Vec::len).unwrap_or_default();
    match largest[..] {
        [] => Err(first_refusal(said)),
        [voice] if voices.len() == 1 => trusted_alone(voice, said, alone),
        [_] => Err(Refusal::Disagreement),
        _ => Ok(weighed(&largest)),
    }
}

/// What the first method said: it is the one that looks hardest for rivals.
fn first_refusal(said: &[Said]) -> Refusal {
    said.iter()
        .find_map(|(_, said)| said.err())
        .unwrap_or(Refusal::NoPeak)
}

/// One method alone, unless another one saw a rival.
fn trusted_alone(
    voice: Voice,
    said: &[Said],
    widened: f64,
) -> Result<(Disparity, Methods), Refusal> {
    let refusals = said.iter().filter_map(|(_, said)| said.err());
    if let Some(why) = refusals.into_iter().find(|why| warns(*why)) {
        return Err(why);
    }
    let found = Disparity {
        sigma_px: (widened * voice.sigma.own_px).hypot(voice.sigma.shared_px),
        ..voice.found
    };
    Ok((found, Methods::only(voice.method)))
}

/// Mean by information.
fn weighed(voices: &[Voice]) -> (Disparity, Methods) {
    let sum: f64 = voices.iter().map(Voice::weight).sum();
    let mean = |value: &dyn Fn(&Voice) -> f64| {
        let weighted = voices.iter().map(|voice| voice.weight() * value(voice));
        weighted.sum::<f64>() / sum
    };
    let px = mean(&|voice| voice.found.px);
    let used = voices
        .iter()
        .map(|voice| Methods::only(voice.method))
        .fold(Methods::default(), Methods::with);
    let own_px = together_px(voices) * disagreement(voices, px);
    let found = Disparity {
        px,
        sigma_px: own_px.hypot(mean(&|voice| voice.sigma.shared_px)),
        // Each voice speaks of its own rows, so their mean speaks of the mean row.
        centroid: RectifiedPixel {
            u: mean(&|voice| voice.found.centroid.u),
            v: mean(&|voice| voice.found.centroid.v),
        },
        ..voices[0].found
    };
    (found, used)
}

/// One sigma of the mean from the methods' own errors, each pair of which is correlated.
fn together_px(voices: &[Voice]) -> f64 {
    // By information each error enters the mean with its reciprocal, over all information.
    let entering: Vec<f64> = voices
        .iter()
        .map(|voice| 1.0 / voice.sigma.own_px)
        .collect();
    let (sum, squares): (f64, f64) = entering
        .iter()
        .fold((0.0, 0.0), |(sum, squares), e| (sum + e, squares + e * e));
    (ALIKE * sum * sum + (1.0 - ALIKE) * squares).sqrt() / squares
}

/// How much further apart the voices are than they say and chance explains (after Birge's ratio), at least 1:
/// agreement by chance narrows nothing.
fn disagreement(voices: &[Voice], mean_px: f64) -> f64 {
    let squares = voices
        .iter()
        .map(|voice| voice.weight() * (voice.found.px - mean_px).powi(2));
    (squares.sum::<f64>() / (BY_CHANCE * (voices.len() - 1) as f64))
        .sqrt()
        .max(1.0)
}
