//! All methods that apply, weighed by what each says of its own error; contradiction is refusal.

use super::scene::Scene;
use super::{
    Disparity, Method, Methods, Miss, RangeConfig, Refusal, centroid, correlate, cross_spectral,
};
use emberfix_calib::RectifiedPixel;

/// One method's disparity.
#[derive(Debug, Clone, Copy)]
struct Voice {
    method: Method,
    found: Disparity,
}

/// Disparities agree when they differ by less than this many of their sigmas, and a little.
const AGREE_SIGMAS: f64 = 3.0;
const AGREE_PX: f64 = 0.4;
/// A flame is about as deep as it is wide, and methods weigh its near and far parts differently: by
/// this share of the depth they may differ.
const AGREE_DEPTH: f64 = 0.12;
/// A single voice is believed this much less.
const ALONE: f64 = 1.5;

/// A correlation above this needs no other voice, unless one contradicts.
const SURE: f64 = 0.9;

/// Correlation and centroids; where they leave doubt the features that survive a change of spectrum
/// decide.
pub(super) fn find(scene: &Scene<'_>, config: &RangeConfig) -> Result<(Disparity, Methods), Miss> {
    let honest = |method: Method, found: &Disparity| scene.honest(method, found);
    let first = refusal(correlate::find(scene, config))?;
    let sure = first.is_ok_and(|said| said.likeness > SURE);
    let first = first.map(|said| honest(Method::Correlate, &said.found));
    let second = centroid::find(scene, config).map(|said| honest(Method::Centroid, &said));
    let depth_px = |px: f64| AGREE_DEPTH * px.abs() * scene.target.width() as f64 / scene.focal_px;
    let agree = |a: &Disparity, b: &Disparity| {
        let apart = AGREE_SIGMAS * a.sigma_px.hypot(b.sigma_px) + AGREE_PX + depth_px(a.px);
        (a.px - b.px).abs() < apart
    };
    let settled = match (&first, &second) {
        (Ok(a), Ok(b)) => agree(a, b),
        (Ok(_), Err(why)) => sure && !warns(*why),
        (Err(_), _) => false,
    };
    let mut said = vec![(Method::Correlate, first), (Method::Centroid, second)];
    if !settled {
        let third = refusal(cross_spectral::find(scene, config))?;
        let third = third.map(|said| honest(Method::CrossSpectral, &said));
        said.push((Method::CrossSpectral, third));
    }
    Ok(decide(&said, agree, if sure { 1.0 } else { ALONE })?)
}

/// Whether a refusal speaks against every other method's answer.
fn warns(why: Refusal) -> bool {
    matches!(
        why,
        Refusal::Ambiguous | Refusal::OneSided | Refusal::TooNear
    )
}

/// A failure is passed on, a refusal is one voice less.
fn refusal<T>(said: Result<T, Miss>) -> Result<Result<T, Refusal>, Miss> {
    match said {
        Ok(found) => Ok(Ok(found)),
        Err(Miss::Refused(why)) => Ok(Err(why)),
        Err(failed) => Err(failed),
    }
}

fn decide(
    said: &[(Method, Result<Disparity, Refusal>)],
    agree: impl Fn(&Disparity, &Disparity) -> bool,
    alone: f64,
) -> Result<(Disparity, Methods), Refusal> {
    let voices: Vec<Voice> = said
        .iter()
        .filter_map(|(method, said)| {
            let found = said.ok()?;
            Some(Voice {
                method: *method,
                found,
            })
        })
        .collect();
    let groups = voices.iter().map(|one| -> Vec<Voice> {
        voices
            .iter()
            .filter(|other| agree(&one.found, &other.found))
            .copied()
            .collect()
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
fn first_refusal(said: &[(Method, Result<Disparity, Refusal>)]) -> Refusal {
    said.iter()
        .find_map(|(_, said)| said.err())
        .unwrap_or(Refusal::NoPeak)
}

/// One method alone, unless another one saw a rival.
fn trusted_alone(
    voice: Voice,
    said: &[(Method, Result<Disparity, Refusal>)],
    widened: f64,
) -> Result<(Disparity, Methods), Refusal> {
    let refusals = said.iter().filter_map(|(_, said)| said.err());
    if let Some(why) = refusals.into_iter().find(|why| warns(*why)) {
        return Err(why);
    }
    let found = Disparity {
        sigma_px: widened * voice.found.sigma_px,
        ..voice.found
    };
    Ok((found, Methods::only(voice.method)))
}

/// Mean by information. They look at the same pixels, so their errors are taken to be one.
fn weighed(voices: &[Voice]) -> (Disparity, Methods) {
    let weight = |voice: &Voice| voice.found.sigma_px.powi(-2);
    let sum: f64 = voices.iter().map(weight).sum();
    let mean = |value: fn(&Disparity) -> f64| {
        let weighted = |voice: &Voice| weight(voice) * value(&voice.found);
        voices.iter().map(weighted).sum::<f64>() / sum
    };
    let used = voices
        .iter()
        .map(|voice| Methods::only(voice.method))
        .fold(Methods::default(), Methods::with);
    let found = Disparity {
        px: mean(|found| found.px),
        // Wholly correlated errors: the mean's is the mean of theirs.
        sigma_px: mean(|found| found.sigma_px),
        // Each voice speaks of its own rows, so their mean speaks of the mean row.
        centroid: RectifiedPixel {
            u: mean(|found| found.centroid.u),
            v: mean(|found| found.centroid.v),
        },
        ..voices[0].found
    };
    (found, used)
}
