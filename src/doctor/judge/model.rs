//! The model: is it there, what runs it, does it keep up.

use super::AtMost;
use crate::detect::ModelError;
use crate::doctor::probe::model::ModelSeen;
use crate::doctor::{Finding, Section, Verdict};
use emberfix_report::{Bound, Figure};
use std::time::Duration;

/// Time for one picture. A fire is told after eight sightings; slower than two seconds a fly-past
/// never has as many.
const LOOK_S: AtMost = AtMost {
    good: 0.5,
    usable: 2.0,
};

/// Loaded, by what it is run, and how long one look takes against the camera's rate.
#[must_use]
pub fn section(seen: &Result<ModelSeen, ModelError>, camera_hz: Option<f64>) -> Section {
    let findings = match seen {
        Err(error) => vec![Finding::fail(
            "model",
            error.to_string(),
            "the service will not start without it: check [model] in the mission; ./x setup brings the \
             runtime",
        )],
        Ok(seen) => vec![loaded(seen), provider(seen), speed(&seen.look, camera_hz)],
    };
    Section {
        title: "Detector",
        findings,
    }
}

fn loaded(seen: &ModelSeen) -> Finding {
    let info = &seen.info;
    let pinned = if seen.pinned {
        "as the mission demands"
    } else {
        "the mission takes any"
    };
    let (width, height) = info.input_px;
    let classes: Vec<String> = info
        .classes
        .iter()
        .map(|class| format!("{} from {:.2}", class.name, class.threshold))
        .collect();
    Finding::pass(
        "model",
        format!(
            "sha256 {}.. ({pinned}), {width}x{height}, {}",
            &info.sha256.get(..12).unwrap_or(&info.sha256),
            classes.join(", ")
        ),
    )
}

fn provider(seen: &ModelSeen) -> Finding {
    let info = &seen.info;
    Finding::pass(
        "runs on",
        format!(
            "{}, {} threads, ONNX Runtime {}",
            info.execution_provider, info.threads, info.onnxruntime_version
        ),
    )
}

fn speed(look: &Result<Duration, String>, camera_hz: Option<f64>) -> Finding {
    let took_s = match look {
        Ok(took) => took.as_secs_f64(),
        Err(reason) => {
            return Finding::fail(
                "one look",
                reason.clone(),
                "the model answers nonsense: take the one that was shipped",
            );
        }
    };
    let keeps_up_hz = 1.0 / took_s.max(1e-6);
    let left_out = camera_hz
        .map(|hz| (1.0 - keeps_up_hz / hz).max(0.0))
        .filter(|share| *share > 0.02);
    let mut value = format!("{:.0} ms, {keeps_up_hz:.1} pictures a second", took_s * 1e3);
    if let Some(share) = left_out {
        value = format!(
            "{value}; {:.0} % of the camera's are left out",
            share * 100.0
        );
    }
    let verdict = LOOK_S
        .judge(took_s)
        .max(if left_out.is_some_and(|s| s > 0.5) {
            Verdict::Warn
        } else {
            Verdict::Pass
        });
    let remedy =
        "give it more threads (model.threads), larger tiles (model.tile_px), or a slower camera";
    Finding::of(verdict, "one look", value, remedy).with(Figure::bounded(
        "doctor.look_ms",
        Some(took_s * 1e3),
        "ms",
        Bound::AtMost(LOOK_S.usable * 1e3),
        3,
    ))
}
