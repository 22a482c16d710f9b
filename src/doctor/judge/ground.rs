//! The ground: will an alarm be heard by anybody.

use super::AtMost;
use crate::deliver::http::HttpError;
use crate::doctor::probe::autopilot::AutopilotSeen;
use crate::doctor::probe::ground::GroundSeen;
use crate::doctor::{Finding, Section};
use crate::mission::Mission;
use emberfix_report::{Bound, Figure};
use std::time::Duration;

/// A test alarm there and back, seconds.
const ROUND_TRIP_S: AtMost = AtMost {
    good: 1.0,
    usable: 5.0,
};

/// Both ways to the ground. One is enough; none is a failure.
#[must_use]
pub fn section(seen: &Option<GroundSeen>, autopilot: &AutopilotSeen, mission: &Mission) -> Section {
    let mut findings = Vec::new();
    let by_ip = seen.as_ref().is_some_and(|seen| seen.test.is_ok());
    match seen {
        Some(seen) => {
            findings.extend([station(seen), test_alarm(seen)]);
            findings.extend(seen.datagrams.as_ref().map(datagrams));
        }
        None => findings.push(Finding::pass(
            "ground station",
            "none by IP in this mission",
        )),
    }
    findings.push(agent(autopilot, mission, by_ip));
    Section {
        title: "Ground",
        findings,
    }
}

fn station(seen: &GroundSeen) -> Finding {
    match &seen.health {
        Ok(health) => Finding::pass(
            "ground station",
            format!("{}, version {}", seen.url, health.version),
        ),
        Err(error) => Finding::fail("ground station", error.to_string(), error.remedy()),
    }
}

fn test_alarm(seen: &GroundSeen) -> Finding {
    match &seen.test {
        Ok(took) => told(*took),
        Err(HttpError::Refused { status: 404, .. }) => Finding::warn(
            "test alarm",
            "this ground station knows no test alarms",
            "bring the ground station to the version of the service",
        ),
        Err(error) => Finding::fail("test alarm", error.to_string(), error.remedy()),
    }
}

/// Without them alarms go by HTTP alone: they arrive, but a lossy link delays them by seconds.
fn datagrams(answered: &Result<Duration, String>) -> Finding {
    match answered {
        Ok(took) => Finding::pass(
            "datagrams",
            format!("answered in {:.0} ms", took.as_secs_f64() * 1e3),
        ),
        Err(problem) => Finding::warn(
            "datagrams",
            format!("{problem}; alarms go by HTTP alone"),
            "at the ground, give [[uav]] our name and public_key (emberfix keys MISSION prints it; beyond \
             loopback a ground without any takes no datagrams) and let UDP through to the port of \
             ground.url; or set ground.datagrams = false",
        ),
    }
}

fn told(took: Duration) -> Finding {
    let value = format!(
        "answered in {:.0} ms, shown as a test, kept nowhere",
        took.as_secs_f64() * 1e3
    );
    let remedy = "the link is slow: alarms will be late";
    Finding::of(
        ROUND_TRIP_S.judge(took.as_secs_f64()),
        "test alarm",
        value,
        remedy,
    )
    .with(Figure::bounded(
        "doctor.ground_round_trip_ms",
        Some(took.as_secs_f64() * 1e3),
        "ms",
        Bound::AtMost(ROUND_TRIP_S.usable * 1e3),
        1,
    ))
}

fn agent(autopilot: &AutopilotSeen, mission: &Mission, by_ip: bool) -> Finding {
    let (system, component) = mission.ground.agent;
    let address = format!("{system}/{component}");
    if autopilot.agent_heard {
        return Finding::pass("ground agent", format!("{address} heard over MAVLink"));
    }
    let value = format!("{address} not heard over MAVLink");
    if by_ip {
        return Finding::warn(
            "ground agent",
            format!("{value}; alarms go by IP only"),
            "fine if meant so; else start the agent and let the autopilot pass messages on (PX4: \
             MAV_1_FORWARD = 1)",
        );
    }
    Finding::fail(
        "ground agent",
        format!("{value}, and no ground station by IP: alarms would reach nobody"),
        "start emberfix ground and set ground.url, or let the autopilot pass messages on (PX4: \
         MAV_1_FORWARD = 1)",
    )
}
