//! The companion computer: disk, outbox, clock.

use super::{AtLeast, AtMost};
use crate::doctor::probe::autopilot::AutopilotSeen;
use crate::doctor::probe::computer::{ComputerSeen, DiskSpeed};
use crate::doctor::probe::ground::GroundSeen;
use crate::doctor::{Finding, Section, Verdict};
use emberfix_frames::ServiceTime;
use emberfix_report::{Bound, Figure};

const GB: f64 = 1e9;
/// Free space, bytes. Pictures of a flight of half an hour at 3 pairs a second take 3 GB.
const FREE_BYTES: AtLeast = AtLeast {
    good: 4.0 * GB,
    usable: 0.3 * GB,
};
/// Write speed, bytes per second: pairs at 10 Hz take 6 MB/s.
const SPEED: AtLeast = AtLeast {
    good: 10e6,
    usable: 1e6,
};
/// A small synced write, seconds: each alarm waits for one.
const SYNC_S: AtMost = AtMost {
    good: 0.1,
    usable: 1.0,
};
/// Clocks of two computers that keep time agree within this, seconds.
const APART_S: AtMost = AtMost {
    good: 1.0,
    usable: 60.0,
};
/// 2026-01-01, before which no clock of a computer that runs this program can be right.
const NOT_BEFORE_NS: i64 = 1_767_225_600_000_000_000;
/// 2080-01-01, likewise.
const NOT_AFTER_NS: i64 = 3_471_292_800_000_000_000;

/// All about the computer.
#[must_use]
pub fn section(
    seen: &ComputerSeen,
    now: ServiceTime,
    autopilot: &AutopilotSeen,
    ground: &Option<GroundSeen>,
) -> Section {
    let mut findings = vec![disk(seen)];
    findings.extend(seen.written.as_ref().map(|written| speed(seen, written)));
    findings.push(outbox(seen));
    let theirs = ground
        .as_ref()
        .and_then(|ground| ground.health.as_ref().ok())
        .and_then(|health| health.ahead)
        .map(|ahead| ahead.as_secs_f64());
    findings.push(clock(now, autopilot.utc_ahead_s, theirs));
    Section {
        title: "Computer",
        findings,
    }
}

/// The clock, where nothing else can be examined.
#[must_use]
pub fn clock_alone(now: ServiceTime) -> Section {
    Section {
        title: "Computer",
        findings: vec![clock(now, None, None)],
    }
}

fn disk(seen: &ComputerSeen) -> Finding {
    let Some(bytes) = seen.free_bytes else {
        return Finding::fail(
            "disk space",
            format!("{} can't be asked", seen.folder),
            "make the state folder, or set state.dir right",
        );
    };
    let value = format!("{:.1} GB free in {}", bytes as f64 / GB, seen.folder);
    let remedy = "make room: recordings stop when the disk is full, alarms are lost when it is";
    Finding::of(FREE_BYTES.judge(bytes as f64), "disk space", value, remedy).with(Figure::bounded(
        "doctor.disk_free_gb",
        Some(bytes as f64 / GB),
        "GB",
        Bound::AtLeast(FREE_BYTES.usable / GB),
        1,
    ))
}

fn speed(seen: &ComputerSeen, written: &Result<DiskSpeed, String>) -> Finding {
    let speed = match written {
        Ok(speed) => speed,
        Err(reason) => {
            return Finding::fail(
                "disk writes",
                format!("{}: {reason}", seen.folder),
                "an alarm is on disk before it is sent: make the folder writable, or set state.dir",
            );
        }
    };
    let sync_s = speed.sync.as_secs_f64();
    let value = format!(
        "{:.0} MB a second; an alarm is safe in {:.0} ms",
        speed.bytes_per_s / 1e6,
        sync_s * 1e3
    );
    let verdict = SPEED.judge(speed.bytes_per_s).max(SYNC_S.judge(sync_s));
    let remedy = "a faster card or disk: alarms wait for it, and recordings lose pictures";
    Finding::of(verdict, "disk writes", value, remedy).with(Figure::bounded(
        "doctor.alarm_sync_ms",
        Some(sync_s * 1e3),
        "ms",
        Bound::AtMost(SYNC_S.usable * 1e3),
        1,
    ))
}

fn outbox(seen: &ComputerSeen) -> Finding {
    match &seen.waiting {
        None => Finding::pass("outbox", "none yet: starts empty"),
        Some(Err(reason)) => Finding::fail(
            "outbox",
            reason.clone(),
            "is the service running already? else move the file away and keep it",
        ),
        Some(Ok(links)) => {
            let waiting: Vec<String> = links
                .iter()
                .filter(|(_, count)| *count > 0)
                .map(|(link, count)| format!("{count} over {link}"))
                .collect();
            if waiting.is_empty() {
                return Finding::pass("outbox", "nothing waits");
            }
            Finding::warn(
                "outbox",
                format!(
                    "alarms of an earlier flight still wait: {}",
                    waiting.join(", ")
                ),
                "they will be told first; move outbox.sqlite away if nobody wants them",
            )
        }
    }
}

fn clock(now: ServiceTime, autopilot_s: Option<f64>, ground_s: Option<f64>) -> Finding {
    let text: String = now.rfc3339().chars().take(19).collect();
    let text = text.replace('T', " ");
    if !(NOT_BEFORE_NS..NOT_AFTER_NS).contains(&now.unix_ns()) {
        let value = format!("says {text} UTC, which can't be");
        return Finding::fail("UTC", value, "set the clock (chrony, GNSS) before take-off");
    }
    let apart = [("the autopilot", autopilot_s), ("the ground", ground_s)];
    let mut verdict = Verdict::Pass;
    let mut value = text;
    for (who, ahead_s) in apart {
        if let Some(ahead_s) = ahead_s {
            verdict = verdict.max(APART_S.judge(ahead_s.abs()));
            value = format!("{value}, {who} {}", ahead(ahead_s));
        }
    }
    let remedy = "set the clocks by one source: alarms carry ours, and people compare";
    // Times of fires would be wrong, their places not.
    Finding::of(verdict.min(Verdict::Warn), "UTC", value, remedy)
}

fn ahead(seconds: f64) -> String {
    if seconds.abs() < APART_S.good {
        return "agrees".to_owned();
    }
    let way = if seconds > 0.0 { "ahead" } else { "behind" };
    format!("{:.0} s {way}", seconds.abs())
}
