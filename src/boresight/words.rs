//! What the flight could not show, and what to fly instead.

use super::model::Parameter;
use super::solve::Solution;

/// A parameter whose sigma shrank to less than this share of what it was is known from the flight.
const LEARNED: f64 = 0.5;
/// Correlation beyond which two parameters are one.
const ALIKE: f64 = 0.8;
/// Share of sights in turns to one side that makes the flight one-sided.
const ONE_SIDED: f64 = 0.15;
/// Turn rate at which a clock of 5 ms is seen in a tenth of a degree, rad/s.
const RESTLESS_RAD_S: f64 = 0.1;
/// A clock known to this is known well enough, seconds.
const CLOCK_S: f64 = 0.005;
/// A boresight known to this is known well enough, radians.
const BORESIGHT_RAD: f64 = 0.001_75;

/// One sentence per thing that remains unknown, with what would show it; empty when nothing does.
#[must_use]
pub fn observability(solution: &Solution) -> Vec<String> {
    let mut words = Vec::new();
    words.extend(clock(solution));
    words.extend(mount(solution));
    words.extend(bearing(solution));
    words.extend(arm(solution));
    if !solution.surveyed {
        words.push(
            "without a surveyed marker a constant GNSS offset can't be seen, and takes the marker with \
             it; heading and mount yaw are only as good as the flight's shape: survey the marker and \
             give --marker LAT,LON,H"
                .to_owned(),
        );
    }
    words
}

/// How much smaller a sigma has become.
fn learned(solution: &Solution, parameter: Parameter, axis: usize) -> bool {
    let index = parameter as usize + axis;
    solution.sigma(index) < LEARNED * solution.before[index]
}

fn clock(solution: &Solution) -> Option<String> {
    let index = Parameter::Clock as usize;
    let sigma = solution.sigma(index);
    if sigma <= CLOCK_S {
        return None;
    }
    let (left, right) = solution.turned;
    let advice = if solution.rate_rad_s < RESTLESS_RAD_S {
        "gusts or turns are needed to see the clock: yaw to and fro while the marker is in view"
    } else if left < ONE_SIDED && right >= ONE_SIDED {
        "all turns went right, which looks like a turned mount: fly a left turn too"
    } else if right < ONE_SIDED && left >= ONE_SIDED {
        "all turns went left, which looks like a turned mount: fly a right turn too"
    } else {
        "fly longer, with the marker in view while turning"
    };
    Some(format!(
        "the clock is known to {:.0} ms only: {advice}",
        sigma * 1e3
    ))
}

fn mount(solution: &Solution) -> Vec<String> {
    [
        (Parameter::MountRoll, "roll about the nose"),
        (Parameter::MountPitch, "pitch"),
    ]
    .iter()
    .filter(|(parameter, _)| {
        let sigma = solution.sigma(*parameter as usize);
        sigma > BORESIGHT_RAD
    })
    .map(|(parameter, axis)| {
        let sigma_deg = solution.sigma(*parameter as usize).to_degrees();
        format!(
            "the mount's {axis} is known to {sigma_deg:.2} degrees: pass the marker on all headings, and \
             let it cross the picture from edge to edge"
        )
    })
    .collect()
}

fn bearing(solution: &Solution) -> Option<String> {
    let (yaw, heading) = (Parameter::MountYaw as usize, Parameter::Heading as usize);
    let sigma = solution.sigma(yaw);
    if sigma <= BORESIGHT_RAD {
        return None;
    }
    let together_deg = solution.bearing_sigma().to_degrees();
    if solution.correlation(yaw, heading).abs() > ALIKE {
        return Some(format!(
            "the mount's yaw ({:.2} degrees) can't be told from the autopilot's heading error; together \
             they are known to {together_deg:.2} degrees: align the heading first (two GNSS antennas, a \
             compass swing), or fly with more bank and pitch",
            sigma.to_degrees()
        ));
    }
    Some(format!(
        "the mount's yaw is known to {:.2} degrees: pass the marker on all headings",
        sigma.to_degrees()
    ))
}

fn arm(solution: &Solution) -> Option<String> {
    let axes = ["forward", "right", "down"];
    let open: Vec<&str> = (0..3)
        .filter(|axis| !learned(solution, Parameter::Arm, *axis))
        .map(|axis| axes[axis])
        .collect();
    if open.is_empty() {
        return None;
    }
    Some(format!(
        "the lever arm ({}) stays as it was measured: only a pass within a few metres of the marker shows \
         it, and a ruler does as well",
        open.join(", ")
    ))
}
