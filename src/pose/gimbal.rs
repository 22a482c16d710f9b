//! How the platform that carries the cameras stood, when it is a gimbal.
//!
//! A gimbal's quaternion counts roll and pitch from the horizon and yaw from north or from the
//! vehicle's nose. Interpolated in its own frame, then turned by the airframe's heading at the
//! shutter where yaw counts from the nose.

use super::{Bracket, History, PoseAnswer, TURN_ACCELERATION_RAD_S2, bracket, unseen};
use emberfix_frames::{
    Attitude, BootTime, ServiceTime, SignedDuration, TimeSync, UnitQuaternion, Vector3,
};
use emberfix_mav::ComponentId;
use emberfix_mav::telemetry::{GimbalDeviceAttitude, GimbalYaw};
use std::f64::consts::PI;

/// The gimbal that carries the rig.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GimbalConfig {
    /// Body origin to the point about which the gimbal turns, body axes, metres. The rig's lever
    /// arm counts from there, in gimbal axes.
    pub pivot_m: Vector3<f64>,
    /// MAVLink component that reports it; `None` takes the first that does.
    pub component: Option<ComponentId>,
    /// Which of the gimbals that hang on that component; 0 is the component itself.
    pub device: u8,
}

/// What the gimbal has said.
#[derive(Debug)]
pub(super) struct Gimbal {
    config: GimbalConfig,
    sender: Option<ComponentId>,
    clock: TimeSync,
    samples: History<Sample>,
}

#[derive(Debug, Clone, Copy)]
struct Sample {
    quaternion: UnitQuaternion<f64>,
    yaw: GimbalYaw,
    nose_rad: Option<f64>,
}

/// The platform at the shutter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Platform {
    /// Platform (forward, right, down) to NED.
    pub(super) attitude: Attitude,
    /// About the platform's axes, rad/s.
    pub(super) rate_rad_s: Vector3<f64>,
    /// New in each frame, radians per axis.
    pub(super) noise_rad: f64,
    /// Time between the samples about the shutter.
    pub(super) gap: SignedDuration,
}

/// How the airframe stood and turned at the shutter.
#[derive(Debug, Clone, Copy)]
pub(super) struct Airframe {
    pub(super) attitude: Attitude,
    pub(super) rate_rad_s: Vector3<f64>,
}

/// Further apart than this the gimbal's idea of the nose is another frame, not another compass.
const NOSE_LIMIT_RAD: f64 = 20.0 * PI / 180.0;
/// A gimbal that has not been heard since may have slewed this fast, rad/s (one sigma).
const SLEW_RAD_S: f64 = 0.5;

impl Gimbal {
    pub(super) fn new(config: GimbalConfig) -> Self {
        Self {
            config,
            sender: config.component,
            clock: TimeSync::new(),
            samples: History::new(),
        }
    }

    pub(super) fn pivot_m(&self) -> Vector3<f64> {
        self.config.pivot_m
    }

    /// Takes a report in; false when it is another gimbal's, or not to be believed.
    pub(super) fn add(
        &mut self,
        sender: ComponentId,
        arrived: ServiceTime,
        said: &GimbalDeviceAttitude,
    ) -> bool {
        let ours = *self.sender.get_or_insert(sender) == sender;
        if !ours || said.device != self.config.device || said.is_faulty {
            return false;
        }
        if sender != ComponentId::AUTOPILOT {
            self.clock.add_arrival(said.boot, arrived);
        }
        if self
            .samples
            .latest()
            .is_some_and(|last| said.boot < last - super::REBOOT)
        {
            self.samples.clear();
        }
        let sample = Sample {
            quaternion: said.quaternion,
            yaw: said.yaw,
            nose_rad: said.nose_rad,
        };
        self.samples.push(said.boot, sample);
        true
    }

    /// The platform at a moment, given as service time and on the autopilot's clock.
    pub(super) fn at(
        &self,
        moment: ServiceTime,
        boot: BootTime,
        airframe: &Airframe,
        (limit, waiting): (SignedDuration, bool),
    ) -> Result<Platform, PoseAnswer> {
        const WHAT: &str = "gimbal attitude";
        // A gimbal on its own has a clock of its own; one on the autopilot has the autopilot's.
        let own = if self.sender == Some(ComponentId::AUTOPILOT) {
            boot
        } else {
            self.clock
                .to_boot(moment)
                .ok_or(PoseAnswer::NeverSeen { what: WHAT })?
        };
        let found = bracket(&self.samples, own, WHAT, limit, waiting)?;
        check_nose(&found.nearest(), airframe)?;
        Ok(platform(&found, airframe))
    }

    /// One sigma of the relation of the gimbal's clock, seconds, where it has one of its own.
    pub(super) fn time_sigma_s(&self) -> f64 {
        self.clock.sigma_s().unwrap_or(0.0)
    }
}

/// Wrong frame flags show where the gimbal also says how it takes the vehicle to head.
fn check_nose(sample: &Sample, airframe: &Airframe) -> Result<(), PoseAnswer> {
    let (_, _, heading) = airframe.attitude.angles();
    let Some(nose) = sample.nose_rad else {
        return Ok(());
    };
    let off = ((nose - heading + PI).rem_euclid(2.0 * PI) - PI).abs();
    if off <= NOSE_LIMIT_RAD {
        return Ok(());
    }
    Err(PoseAnswer::Conflict {
        what: "gimbal's and autopilot's heading",
        apart_deg: off.to_degrees(),
        limit_deg: NOSE_LIMIT_RAD.to_degrees(),
    })
}

fn platform(found: &Bracket<Sample>, airframe: &Airframe) -> Platform {
    let (sample, turning, noise_rad) = match found.later {
        Some((_, later)) if later.yaw == found.earlier.1.yaw => {
            let earlier = found.earlier.1;
            let step = earlier.quaternion.rotation_to(&later.quaternion);
            let quaternion = earlier
                .quaternion
                .try_slerp(&later.quaternion, found.share(), 1e-9)
                .unwrap_or(later.quaternion);
            // World-side step to platform axes: the same turn, seen from the platform.
            let turned = earlier.quaternion.inverse() * step.scaled_axis();
            let sample = Sample {
                quaternion,
                ..found.nearest()
            };
            let noise = unseen(TURN_ACCELERATION_RAD_S2, found.span_s());
            (sample, turned / found.span_s().max(1e-3), noise)
        }
        _ => {
            let off = found.distance().as_secs_f64();
            (found.nearest(), Vector3::zeros(), SLEW_RAD_S * off)
        }
    };
    let (roll, pitch, heading) = airframe.attitude.angles();
    let (attitude, carried) = match sample.yaw {
        GimbalYaw::FromNorth => (sample.quaternion, Vector3::zeros()),
        GimbalYaw::FromNose => {
            let level = UnitQuaternion::from_euler_angles(0.0, 0.0, heading);
            let attitude = level * sample.quaternion;
            let w = airframe.rate_rad_s;
            let nose_rate = (w.y * roll.sin() + w.z * roll.cos()) / pitch.cos().max(0.1);
            (attitude, attitude.inverse() * (Vector3::z() * nose_rate))
        }
    };
    Platform {
        attitude: Attitude::from_unit_quaternion(attitude),
        rate_rad_s: turning + carried,
        noise_rad,
        gap: found.gap(),
    }
}
