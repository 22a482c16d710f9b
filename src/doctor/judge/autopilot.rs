//! The autopilot: is it heard, often enough, on one clock with us, and does it know where it is.

use super::{AtLeast, AtMost};
use crate::doctor::probe::autopilot::{AutopilotSeen, SyncSeen};
use crate::doctor::{Finding, Section, Verdict};
use crate::mission::Mission;
use emberfix_frames::SyncQuality;
use emberfix_mav::telemetry::{GnssFix, GpsRaw};
use emberfix_report::{Bound, Figure};

const ATTITUDE_QUATERNION: u32 = 31;
const ATTITUDE: u32 = 30;
const POSITION: u32 = 33;
const GPS_RAW: u32 = 24;

/// Attitudes per second. Interpolating at 50 Hz errs by 0.01 degrees when it turns as hard as a
/// multirotor does, at 10 Hz by 0.25.
const ATTITUDE_HZ: AtLeast = AtLeast {
    good: 40.0,
    usable: 10.0,
};
/// Positions per second.
const POSITION_HZ: AtLeast = AtLeast {
    good: 10.0,
    usable: 2.0,
};
/// The receiver's word; older than 3 s there are no positions.
const GNSS_HZ: AtLeast = AtLeast {
    good: 1.0,
    usable: 0.4,
};
/// One sigma of the clocks' relation, seconds: 5 ms at 60 degrees a second are 0.3 degrees.
const CLOCK_S: AtMost = AtMost {
    good: 0.005,
    usable: 0.05,
};
/// Satellites.
const SATELLITES: AtLeast = AtLeast {
    good: 10.0,
    usable: 6.0,
};
/// The receiver's own one sigma, horizontal, metres.
const GNSS_SIGMA_M: AtMost = AtMost {
    good: 3.0,
    usable: 10.0,
};
/// A rate is counted to one message at either end of the window.
const COUNTING: f64 = 1.1;
/// Share of frames whose checksum fails.
const BAD_FRAMES: f64 = 0.01;

/// All about the autopilot.
#[must_use]
pub fn section(seen: &AutopilotSeen, mission: &Mission) -> Section {
    let findings = match absent(seen, mission) {
        Some(absent) => vec![absent],
        None => present(seen),
    };
    Section {
        title: "Autopilot",
        findings,
    }
}

fn absent(seen: &AutopilotSeen, mission: &Mission) -> Option<Finding> {
    let url = &mission.mavlink_url;
    if seen.hangs {
        return Some(Finding::fail(
            "heartbeat",
            format!("{url} does not answer, not even with an error"),
            "look at the serial device and its driver",
        ));
    }
    if let Some(reason) = &seen.broken {
        return Some(Finding::fail(
            "heartbeat",
            reason.clone(),
            "free the port (is the service running already?) or set mavlink.url right",
        ));
    }
    if seen.vehicle.is_some() {
        return None;
    }
    let others: Vec<String> = seen.others.iter().map(u8::to_string).collect();
    let wire = seen.wire;
    let (value, remedy) = if !others.is_empty() {
        (
            format!(
                "system {} was not heard, but {} was",
                mission.system_id,
                others.join(", ")
            ),
            "set vehicle.system_id to that of the autopilot (MAV_SYS_ID), or to 0",
        )
    } else if wire.frames > 0 {
        (
            format!("{} frames on {url}, none of an autopilot", wire.frames),
            "does a router send us the autopilot's messages?",
        )
    } else if wire.garbage_bytes > 0 {
        (
            format!(
                "{} bytes on {url}, none of them MAVLink",
                wire.garbage_bytes
            ),
            "set the baud rate of mavlink.url to the autopilot's (SER_TEL2_BAUD)",
        )
    } else {
        (
            format!("nothing came on {url}"),
            "power the autopilot, look at cable and port; PX4: MAV_1_CONFIG = TELEM 2, mode Onboard",
        )
    };
    Some(Finding::fail("heartbeat", value, remedy))
}

fn present(seen: &AutopilotSeen) -> Vec<Finding> {
    let mut findings = vec![heartbeat(seen)];
    findings.extend(one_vehicle(seen));
    findings.extend(wire(seen));
    findings.push(attitude(seen));
    findings.push(rate(
        seen,
        "position",
        POSITION,
        POSITION_HZ,
        "doctor.position_hz",
    ));
    findings.push(rate(
        seen,
        "GNSS messages",
        GPS_RAW,
        GNSS_HZ,
        "doctor.gnss_hz",
    ));
    findings.extend(seen.sync.map(|sync| clock(&sync)));
    findings.push(gnss(seen.gnss.as_ref()));
    findings.push(estimator(seen));
    findings.extend(refused(seen));
    findings
}

fn heartbeat(seen: &AutopilotSeen) -> Finding {
    let system = seen.vehicle.map_or(0, |system| system.0);
    let state = match seen.heartbeat {
        Some(heartbeat) if heartbeat.armed => "armed",
        Some(_) => "disarmed",
        None => "no state",
    };
    Finding::pass("heartbeat", format!("system {system}, {state}"))
}

fn one_vehicle(seen: &AutopilotSeen) -> Option<Finding> {
    if seen.others.is_empty() {
        return None;
    }
    let others: Vec<String> = seen.others.iter().map(u8::to_string).collect();
    Some(Finding::warn(
        "other vehicles",
        format!("autopilots {} are on the same link", others.join(", ")),
        "set vehicle.system_id in the mission, so that the right one counts",
    ))
}

fn wire(seen: &AutopilotSeen) -> Option<Finding> {
    let share = seen.wire.crc as f64 / (seen.wire.frames + seen.wire.crc).max(1) as f64;
    (share > BAD_FRAMES).then(|| {
        Finding::warn(
            "link quality",
            format!("{:.1} % of frames are damaged", share * 100.0),
            "look at the cable, ground and baud rate of the autopilot's port",
        )
    })
}

fn attitude(seen: &AutopilotSeen) -> Finding {
    let by_quaternion = seen.rate_hz(ATTITUDE_QUATERNION) > 0.0;
    let id = if by_quaternion {
        ATTITUDE_QUATERNION
    } else {
        ATTITUDE
    };
    rate(seen, "attitude", id, ATTITUDE_HZ, "doctor.attitude_hz")
}

fn rate(
    seen: &AutopilotSeen,
    name: &'static str,
    id: u32,
    limits: AtLeast,
    figure: &'static str,
) -> Finding {
    let hz = seen.rate_hz(id);
    let message = emberfix_mav::message_name(id);
    let value = if hz > 0.0 {
        format!("{message} {hz:.1} a second ({} is enough)", limits.good)
    } else {
        format!("{message} does not come")
    };
    let remedy = "let the autopilot's port send more: PX4 MAV_1_MODE = Onboard, MAV_1_RATE high enough; \
                  or a faster baud rate";
    let n = seen.counts.get(&id).copied().unwrap_or(0) as usize;
    Finding::of(limits.judge(hz * COUNTING), name, value, remedy).with(Figure::bounded(
        figure,
        Some(hz),
        "Hz",
        Bound::AtLeast(limits.usable),
        n,
    ))
}

fn clock(sync: &SyncSeen) -> Finding {
    let sigma_s = sync.sigma_s.unwrap_or(f64::INFINITY);
    let answers = format!("{} of {} requests answered", sync.answered, sync.asked);
    let finding = match sync.quality {
        SyncQuality::Converged | SyncQuality::Converging => Finding::of(
            CLOCK_S.judge(sigma_s),
            "clock",
            format!("known to {:.1} ms, {answers}", sigma_s * 1e3),
            "the link is slow or busy: a faster baud rate, fewer messages",
        ),
        SyncQuality::ArrivalOnly | SyncQuality::None => Finding::warn(
            "clock",
            format!("TIMESYNC is not answered ({answers}); times rest on arrival"),
            "let the autopilot answer TIMESYNC (mavlink-router must pass it on); until then ellipses \
             are wider",
        ),
    };
    finding.with(Figure::bounded(
        "doctor.clock_sigma_ms",
        sync.sigma_s.map(|s| s * 1e3),
        "ms",
        Bound::AtMost(CLOCK_S.usable * 1e3),
        sync.answered as usize,
    ))
}

fn gnss(raw: Option<&GpsRaw>) -> Finding {
    let Some(raw) = raw else {
        return Finding::fail(
            "GNSS",
            "GPS_RAW_INT does not come: no position will be told",
            "let the autopilot's port send GPS_RAW_INT",
        );
    };
    let class = match raw.fix {
        GnssFix::None => "no receiver",
        GnssFix::NoFix => "no fix",
        GnssFix::Fix2d => "2D only",
        GnssFix::Fix3d => "3D",
        GnssFix::Dgps => "3D with corrections",
        GnssFix::RtkFloat => "RTK, float",
        GnssFix::RtkFixed => "RTK, fixed",
    };
    let mut value = class.to_owned();
    if let Some(satellites) = raw.satellites {
        value = format!("{value}, {satellites} satellites");
    }
    if let (Some(h), Some(v)) = (raw.horizontal_sigma_m, raw.vertical_sigma_m) {
        value = format!("{value}, \u{b1}{h:.2} m across and \u{b1}{v:.2} m up by its own word");
    }
    let verdict = if raw.fix.is_3d() {
        let satellites = raw.satellites.map_or(Verdict::Warn, |n| {
            SATELLITES.judge(f64::from(n)).min(Verdict::Warn)
        });
        let sigma = raw.horizontal_sigma_m.map_or(Verdict::Pass, |sigma| {
            GNSS_SIGMA_M.judge(sigma).min(Verdict::Warn)
        });
        satellites.max(sigma)
    } else {
        Verdict::Fail
    };
    let remedy =
        "wait under open sky, away from metal and transmitters, until the fix is 3D and good";
    Finding::of(verdict, "GNSS", value, remedy).with(Figure::told(
        "doctor.satellites",
        raw.satellites.map(f64::from),
        "",
        1,
    ))
}

fn estimator(seen: &AutopilotSeen) -> Finding {
    let Some(status) = seen.estimator else {
        return Finding::warn(
            "estimator",
            "ESTIMATOR_STATUS does not come: nobody says whether position and attitude are valid",
            "let the autopilot's port send ESTIMATOR_STATUS",
        );
    };
    let flags = status.flags;
    let bad: Vec<&str> = [
        ("attitude", flags.attitude()),
        ("horizontal position", flags.horizontal_position()),
        ("height", flags.vertical_position()),
    ]
    .iter()
    .filter(|(_, good)| !good)
    .map(|(what, _)| *what)
    .collect();
    if !bad.is_empty() {
        return Finding::fail(
            "estimator",
            format!("says that its {} is not valid", bad.join(", ")),
            "wait until the autopilot has aligned itself and found its place",
        );
    }
    if flags.gnss_glitch() {
        return Finding::warn(
            "estimator",
            "sees GNSS jump",
            "wait; look for reflections and interference",
        );
    }
    Finding::pass("estimator", "attitude, position and height are valid")
}

fn refused(seen: &AutopilotSeen) -> Option<Finding> {
    if seen.refused.is_empty() {
        return None;
    }
    let each: Vec<String> = seen
        .refused
        .iter()
        .map(|(reason, count)| format!("{reason} {count} times"))
        .collect();
    Some(Finding::warn(
        "impossible values",
        each.join(", "),
        "the autopilot says what cannot be: its estimator may not be ready",
    ))
}
