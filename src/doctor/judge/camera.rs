//! The camera: do both eyes deliver, in step, fresh, and do they see.

use super::{AtLeast, AtMost, median};
use crate::doctor::probe::camera::{CameraSeen, EyeSeen};
use crate::doctor::{Finding, Section, Verdict};
use crate::ingest::{CaptureClock, EyeHealth};
use emberfix_calib::Rig;
use emberfix_report::{Bound, Figure};

/// Pairs per second. A fire is told after eight sightings; a fly-past at 6 m/s lasts some seconds.
const RATE_HZ: AtLeast = AtLeast {
    good: 2.0,
    usable: 0.5,
};
/// Pairs that must come before a rate is believed.
const FEW_PAIRS: usize = 3;
/// Share of pairs that have both eyes.
const BOTH_EYES: AtLeast = AtLeast {
    good: 0.98,
    usable: 0.5,
};
/// A longest gap beyond this many usual ones is a hiccup.
const HICCUP: f64 = 3.0;
/// Delay from exposure to arrival, seconds: the pose history holds 10 s, an alarm should come sooner.
const DELAY_S: (f64, f64) = (-0.005, 1.0);
/// Mean grey level between which an eye is well exposed.
const EXPOSED: (f64, f64) = (35.0, 220.0);
/// Share of burnt out pixels that is still the sky.
const BURNT: f64 = 0.35;
/// Mean levels of the eyes may differ by this factor: gain of each is automatic.
const GAIN_RATIO: f64 = 1.6;
/// Edges of the eyes may differ by this factor before one is out of focus or dirty.
const SHARPNESS_RATIO: f64 = 1.7;
/// Rows between the eyes, pixels. Calibration leaves 0.3; beyond 2 nothing matches.
const ROWS_PX: AtMost = AtMost {
    good: 0.5,
    usable: 2.0,
};
/// Edges (Laplacian over mean level) below which a picture of the outdoors is a blur.
const BLUR: f64 = 0.02;

/// All about the camera.
#[must_use]
pub fn section(seen: &CameraSeen, rig: &Rig, url: &str) -> Section {
    let findings = match absent(seen, url) {
        Some(absent) => vec![absent],
        None => present(seen, rig),
    };
    Section {
        title: "Camera",
        findings,
    }
}

fn absent(seen: &CameraSeen, url: &str) -> Option<Finding> {
    if seen.hangs {
        return Some(Finding::fail(
            "pairs",
            format!("{url} does not answer, not even with an error"),
            "unplug the camera and plug it in again; then restart its driver or program",
        ));
    }
    if !seen.pairs.is_empty() {
        return None;
    }
    if let Some(reason) = &seen.broken {
        return Some(Finding::fail(
            "pairs",
            reason.clone(),
            "free the address (is the service running already?) or set camera.url right",
        ));
    }
    let openings = seen.counters.openings;
    let (value, remedy) = if openings > 0 {
        (
            format!("connected {openings} times to {url}, and no pair came"),
            "the camera program is connected and sends nothing that can be used: is the lens side \
             running, are both topics there?",
        )
    } else {
        (
            format!("none came from {url}"),
            "start the camera or the program that feeds it; --wait waits for it",
        )
    };
    Some(Finding::fail("pairs", value, remedy))
}

fn present(seen: &CameraSeen, rig: &Rig) -> Vec<Finding> {
    let mut findings = vec![rate(seen), in_step(seen, rig), delay(seen)];
    findings.extend(refused(seen));
    findings.extend(eye("left eye", &seen.left));
    findings.extend(eye("right eye", &seen.right));
    findings.extend(alike(&seen.left, &seen.right));
    findings.extend(rows(&seen.rows_px));
    findings
}

fn rate(seen: &CameraSeen) -> Finding {
    let count = seen.pairs.len();
    let Some(hz) = seen.rate_hz().filter(|_| count >= FEW_PAIRS) else {
        return Finding::warn(
            "pairs",
            format!("only {count} came, too few to know a rate"),
            "listen longer (--seconds), or find out why the camera is so slow",
        );
    };
    let usual_s = 1.0 / hz;
    let gaps = seen
        .pairs
        .windows(2)
        .map(|w| (w[1].at - w[0].at).as_secs_f64());
    let longest_s = gaps.fold(0.0, f64::max);
    let hiccup = longest_s > HICCUP * usual_s;
    let value = format!("{hz:.1} a second, longest gap {longest_s:.2} s, {count} pairs");
    let verdict = RATE_HZ
        .judge(hz)
        .max(if hiccup { Verdict::Warn } else { Verdict::Pass });
    let remedy = if hiccup {
        "the camera pauses: look at its cable, its bus and its program's load"
    } else {
        "set the camera to 3 pairs a second or more"
    };
    Finding::of(verdict, "pairs", value, remedy).with(Figure::bounded(
        "doctor.camera_hz",
        Some(hz),
        "Hz",
        Bound::AtLeast(RATE_HZ.usable),
        count,
    ))
}

fn in_step(seen: &CameraSeen, rig: &Rig) -> Finding {
    let both = seen
        .pairs
        .iter()
        .filter(|pair| pair.skew_s.is_some())
        .count();
    let share = both as f64 / seen.pairs.len().max(1) as f64;
    let limit_ms = rig.max_skew_s() * 1e3;
    let worst = seen
        .pairs
        .iter()
        .filter_map(|pair| pair.skew_s)
        .map(|skew| skew.abs() * 1e3)
        .fold(None, |worst: Option<f64>, skew| {
            Some(worst.map_or(skew, |worst| worst.max(skew)))
        });
    let value = match worst {
        Some(worst) => format!(
            "both eyes in {:.0} % of pairs, at most {worst:.2} ms apart (rig allows {limit_ms:.1})",
            share * 100.0
        ),
        None => format!("never both eyes within {limit_ms:.1} ms: no stereo"),
    };
    let remedy = "wire the eyes' triggers together and look at the right eye's cable; with one eye the \
                  range comes from flying past and terrain only";
    Finding::of(BOTH_EYES.judge(share), "in step", value, remedy).with(Figure::bounded(
        "doctor.skew_ms",
        worst,
        "ms",
        Bound::AtMost(limit_ms),
        both,
    ))
}

fn delay(seen: &CameraSeen) -> Finding {
    let delays = seen.pairs.iter().map(|p| (p.arrived - p.at).as_secs_f64());
    let middle_s = median(delays).unwrap_or(0.0);
    let (early, late) = DELAY_S;
    let rests_on = match seen.clock {
        CaptureClock::Stated => "times by the source",
        CaptureClock::DriverMonotonic => "times by the driver",
        CaptureClock::StreamPosition => "times by stream position",
        CaptureClock::Arrival => "times of arrival only",
    };
    let value = format!("{:.0} ms from exposure to here, {rests_on}", middle_s * 1e3);
    let figure = Figure::told(
        "doctor.camera_delay_ms",
        Some(middle_s * 1e3),
        "ms",
        seen.pairs.len(),
    );
    let finding = if middle_s < early {
        let remedy =
            "the camera's clock runs ahead of ours: let both keep time by one clock (chrony)";
        Finding::fail("delay", value, remedy)
    } else if middle_s > late {
        let remedy = "is the camera's clock behind ours, or does something queue pictures?";
        Finding::warn("delay", value, remedy)
    } else if seen.clock == CaptureClock::Arrival {
        let remedy = "use a source that says when it exposed: while turning, 50 ms are metres";
        Finding::warn("delay", value, remedy)
    } else {
        Finding::pass("delay", value)
    };
    finding.with(figure)
}

/// What came and could not be used.
fn refused(seen: &CameraSeen) -> Vec<Finding> {
    let mut findings = Vec::new();
    if let Some(reason) = &seen.unreadable {
        let remedy = "the camera must send what the rig was calibrated with, size and format";
        findings.push(Finding::fail("pictures", reason.clone(), remedy));
    }
    if seen.counters.calibration_mismatches > 0 {
        findings.push(Finding::warn(
            "calibration",
            "the camera states another calibration than the rig file",
            "is this the rig of the mission? the rig file counts",
        ));
    }
    let stream = &seen.counters.stream;
    let lost = stream.unreadable + stream.bad_chunks + stream.unstamped + stream.unknown_format;
    let out_of_time = stream.backwards + stream.from_the_future;
    if lost + out_of_time > 0 {
        findings.push(Finding::warn(
            "stream",
            format!("{lost} messages not readable, {out_of_time} with impossible times"),
            "look at the program that feeds the camera's stream",
        ));
    }
    if let Some(reason) = &seen.broken {
        let remedy = "the camera broke off while it was watched: look at its cable and its power";
        findings.push(Finding::fail("stream", reason.clone(), remedy));
    }
    findings
}

fn eye(name: &'static str, looks: &[EyeSeen]) -> Option<Finding> {
    let bad = looks.iter().find(|look| look.health != EyeHealth::Good);
    if let Some(bad) = bad {
        let value = match bad.health {
            EyeHealth::Black { mean, .. } => format!("black (mean level {mean:.0})"),
            EyeHealth::Saturated { mean, .. } => format!("all white (mean level {mean:.0})"),
            EyeHealth::Frozen { frames } => format!("the same picture {frames} times"),
            EyeHealth::Good => String::new(),
        };
        let remedy = "take the cap off, look at the cable, restart the camera";
        return Some(Finding::fail(name, value, remedy));
    }
    let mean = median(looks.iter().map(|look| look.mean))?;
    let burnt = median(looks.iter().map(|look| look.burnt))?;
    let sharpness = median(looks.iter().map(|look| look.sharpness))?;
    let value = format!(
        "mean level {mean:.0} of 255, {:.0} % burnt out, edges {sharpness:.2}",
        burnt * 100.0
    );
    let (dark, bright) = EXPOSED;
    Some(if mean < dark {
        Finding::warn(name, value, "too dark: longer exposure, or more light")
    } else if mean > bright || burnt > BURNT {
        Finding::warn(
            name,
            value,
            "too bright: shorter exposure, or turn it out of the sun",
        )
    } else if sharpness < BLUR {
        Finding::warn(
            name,
            value,
            "nothing sharp is seen: focus, clean the lens, point it at something",
        )
    } else {
        Finding::pass(name, value)
    })
}

/// Whether the rig is still the one that was calibrated: places are on equal rows in both eyes.
fn rows(rows_px: &[f64]) -> Option<Finding> {
    let off_px = median(rows_px.iter().copied())?;
    let value = format!("the same places are {off_px:+.2} rows apart in the two eyes");
    let remedy = "the rig is bent since it was calibrated, or this is another one: emberfix calibrate stereo";
    let figure = Figure::bounded(
        "doctor.rows_apart_px",
        Some(off_px.abs()),
        "px",
        Bound::AtMost(ROWS_PX.usable),
        rows_px.len(),
    );
    Some(Finding::of(ROWS_PX.judge(off_px.abs()), "eyes level", value, remedy).with(figure))
}

/// Both eyes against each other: what one sees well, the other should.
fn alike(left: &[EyeSeen], right: &[EyeSeen]) -> Option<Finding> {
    let ratio = |of: fn(&EyeSeen) -> f64| {
        let (l, r) = (median(left.iter().map(of))?, median(right.iter().map(of))?);
        Some(l.max(1e-6) / r.max(1e-6))
    };
    let (gain, edges) = (ratio(|eye| eye.mean)?, ratio(|eye| eye.sharpness)?);
    let value = format!("left over right: brightness {gain:.2}, edges {edges:.2}");
    let unlike = |ratio: f64, limit: f64| ratio > limit || ratio < 1.0 / limit;
    let finding = if unlike(edges, SHARPNESS_RATIO) {
        let worse = if edges < 1.0 { "left" } else { "right" };
        Finding::warn(
            "eyes alike",
            value,
            format!("the {worse} eye is out of focus or dirty: clean and focus it"),
        )
    } else if unlike(gain, GAIN_RATIO) {
        let remedy = "give both eyes the same exposure and gain";
        Finding::warn("eyes alike", value, remedy)
    } else {
        Finding::pass("eyes alike", value)
    };
    let figure = Figure::told("doctor.sharpness_ratio", Some(edges), "", left.len());
    Some(finding.with(figure))
}
