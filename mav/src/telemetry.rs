//! Frames to what they say, in SI units and typed frames, heights and clocks.
//!
//! "Unknown" has many spellings on the wire (0, 65535, not-a-number, an absent extension); here it
//! is always `None`. A position that cannot be one is an error, never a value.

use crate::wire::{Address, ComponentId, RawFrame, SystemId};
use emberfix_frames::{
    Attitude, AttitudeError, BootTime, EllipsoidHeight, MslAltitude, ServiceTime, UnitQuaternion,
    Vector3,
};
use mavlink::Message;
use mavlink::dialects::development as dialect;
use mavlink::dialects::development::MavMessage;
use mavlink::error::ParserError;

/// What one frame says. Messages that emberfix has no use for are [`Telemetry::Other`].
#[derive(Debug, Clone, PartialEq)]
pub enum Telemetry {
    /// HEARTBEAT.
    Heartbeat(Heartbeat),
    /// ATTITUDE_QUATERNION or ATTITUDE.
    Attitude(AttitudeSample),
    /// GLOBAL_POSITION_INT.
    GlobalPosition(GlobalPosition),
    /// GPS_RAW_INT.
    GpsRaw(GpsRaw),
    /// GPS2_RAW: a second receiver.
    Gps2Raw(GpsRaw),
    /// SYSTEM_TIME.
    SystemTime(SystemTime),
    /// TIMESYNC.
    TimeSync(TimeSyncMessage),
    /// ESTIMATOR_STATUS.
    EstimatorStatus(EstimatorStatus),
    /// HOME_POSITION.
    HomePosition(HomePosition),
    /// GIMBAL_DEVICE_ATTITUDE_STATUS.
    GimbalDeviceAttitude(GimbalDeviceAttitude),
    /// COMMAND_ACK.
    CommandAck(CommandAck),
    /// COMMAND_INT.
    CommandInt(CommandInt),
    /// COMMAND_LONG.
    CommandLong(CommandLong),
    /// STATUSTEXT.
    StatusText(StatusText),
    /// CAMERA_TRACKING_GEO_STATUS.
    CameraTrackingGeoStatus(CameraTrackingGeoStatus),
    /// RADIO_STATUS.
    RadioStatus(RadioStatus),
    /// WIND_COV, where the autopilot knows the wind.
    Wind(WindEstimate),
    /// Anything else.
    Other {
        /// Its id.
        message_id: u32,
    },
}

/// That a component lives, and what it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Heartbeat {
    /// `MAV_TYPE`: 2 is a quadrotor, 6 a ground station, 18 an onboard controller.
    pub vehicle_type: u8,
    /// `MAV_AUTOPILOT`: 8 is "no autopilot", 12 is PX4.
    pub autopilot: u8,
    /// Whether the motors may turn.
    pub armed: bool,
    /// `MAV_STATE`: 3 standby, 4 active, 5 critical.
    pub state: u8,
}

impl Heartbeat {
    /// `MAV_TYPE_QUADROTOR`.
    pub const QUADROTOR: u8 = 2;
    /// `MAV_TYPE_GCS`.
    pub const GROUND_STATION: u8 = 6;
    /// `MAV_TYPE_ONBOARD_CONTROLLER`.
    pub const ONBOARD_CONTROLLER: u8 = 18;
    /// `MAV_AUTOPILOT_INVALID`: the sender flies nothing.
    pub const NO_AUTOPILOT: u8 = 8;
    /// `MAV_AUTOPILOT_PX4`.
    pub const PX4: u8 = 12;
    /// `MAV_STATE_ACTIVE`.
    pub const ACTIVE: u8 = 4;
    /// `MAV_STATE_CRITICAL`.
    pub const CRITICAL: u8 = 5;

    /// Whether the sender flies the vehicle.
    #[must_use]
    pub fn is_autopilot(&self) -> bool {
        self.autopilot != Self::NO_AUTOPILOT && self.vehicle_type != Self::GROUND_STATION
    }
}

/// Which message an attitude came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum AttitudeSource {
    /// ATTITUDE_QUATERNION: preferred.
    Quaternion,
    /// ATTITUDE: angles, fit for links that carry nothing better.
    Angles,
}

/// Attitude at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AttitudeSample {
    /// When it held (millisecond resolution).
    pub boot: BootTime,
    /// Body (FRD) to NED.
    pub attitude: Attitude,
    /// Turn rates about body axes (FRD), rad/s.
    pub rate_rad_s: Vector3<f64>,
    /// Which message carried it.
    pub source: AttitudeSource,
}

/// The estimator's position and velocity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GlobalPosition {
    /// When it held (millisecond resolution).
    pub boot: BootTime,
    /// Geodetic latitude, degrees.
    pub latitude_deg: f64,
    /// Longitude, degrees.
    pub longitude_deg: f64,
    /// Altitude above mean sea level by the autopilot's geoid. PX4 falls back to raw barometric
    /// altitude, or 0, without saying so: hold it against [`EstimatorStatus`].
    pub altitude: MslAltitude,
    /// Height above the home position, metres.
    pub above_home_m: f64,
    /// Velocity north, east, down, m/s.
    pub velocity_ned_m_s: Vector3<f64>,
    /// Nose clockwise from true north, radians, where known.
    pub heading_rad: Option<f64>,
}

/// Quality of a GNSS solution, worst first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum GnssFix {
    /// No receiver.
    None,
    /// A receiver without a solution.
    NoFix,
    /// Position without altitude.
    Fix2d,
    /// Position and altitude.
    Fix3d,
    /// With corrections (DGPS, SBAS, PPP, a surveyed static position).
    Dgps,
    /// RTK, ambiguities not resolved.
    RtkFloat,
    /// RTK, centimetres.
    RtkFixed,
}

impl GnssFix {
    /// Whether there is a position with an altitude.
    #[must_use]
    pub fn is_3d(self) -> bool {
        self >= Self::Fix3d
    }
}

/// A time whose clock the sender may choose: MAVLink tells the two apart by magnitude.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VehicleTime {
    /// Since the autopilot booted.
    Boot(BootTime),
    /// UTC, as far as the vehicle knows.
    Utc(ServiceTime),
}

/// Place by the receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GnssPlace {
    /// Geodetic latitude, degrees.
    pub latitude_deg: f64,
    /// Longitude, degrees.
    pub longitude_deg: f64,
    /// Altitude above mean sea level by the receiver's geoid.
    pub altitude: MslAltitude,
    /// Height above the WGS84 ellipsoid, where the receiver says it.
    pub height: Option<EllipsoidHeight>,
}

/// What the GNSS receiver says, before the estimator.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GpsRaw {
    /// When it held.
    pub time: VehicleTime,
    /// Quality.
    pub fix: GnssFix,
    /// Where; only from a 3D fix up.
    pub place: Option<GnssPlace>,
    /// One sigma, horizontal, metres; `None` is unknown, never perfect.
    pub horizontal_sigma_m: Option<f64>,
    /// One sigma, vertical, metres; `None` is unknown, never perfect.
    pub vertical_sigma_m: Option<f64>,
    /// Speed over ground, m/s.
    pub ground_speed_m_s: Option<f64>,
    /// Direction of motion clockwise from true north, radians.
    pub course_rad: Option<f64>,
    /// Satellites in view.
    pub satellites: Option<u8>,
}

/// Where the air goes, as the autopilot's estimator has it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WindEstimate {
    /// East, north, up, m/s: where it blows to.
    pub towards_enu_m_s: Vector3<f64>,
    /// One sigma per horizontal axis, m/s; `None` where it is not stated.
    pub horizontal_sigma_m_s: Option<f64>,
}

/// The vehicle's two clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SystemTime {
    /// Since boot.
    pub boot: BootTime,
    /// UTC where the vehicle has it, and where it is sane (2009 to 2100).
    pub utc: Option<ServiceTime>,
    /// UTC as it was claimed, microseconds; 0 where unset.
    pub claimed_utc_us: u64,
}

impl SystemTime {
    /// Whether a UTC was claimed that cannot be.
    #[must_use]
    pub fn utc_is_absurd(&self) -> bool {
        self.utc.is_none() && self.claimed_utc_us > UTC_FROM_US
    }
}

/// A request (`tc1` is 0) or a reply, nanoseconds of the clocks of the two sides.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimeSyncMessage {
    /// Clock of the side that replies; 0 in a request.
    pub tc1_ns: i64,
    /// Clock of the side that asked, sent back unchanged.
    pub ts1_ns: i64,
    /// Whom it addresses; older PX4 replies leave it unset, so do not filter by it.
    pub target: Address,
}

impl TimeSyncMessage {
    /// Whether it asks.
    #[must_use]
    pub fn is_request(&self) -> bool {
        self.tc1_ns == 0
    }
}

/// What the estimator thinks of itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EstimatorStatus {
    /// When it held.
    pub time: VehicleTime,
    /// One sigma, horizontal, relative to the estimator's origin, metres.
    pub horizontal_sigma_m: Option<f64>,
    /// One sigma, vertical, metres.
    pub vertical_sigma_m: Option<f64>,
    /// What is valid.
    pub flags: EstimatorFlags,
}

/// `ESTIMATOR_STATUS_FLAGS`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EstimatorFlags(pub u16);

impl EstimatorFlags {
    /// Attitude, velocity, and absolute position are all valid.
    pub const HEALTHY: Self = Self(0b11_0111);

    /// Attitude is valid.
    #[must_use]
    pub fn attitude(self) -> bool {
        self.0 & 1 != 0
    }
    /// Absolute horizontal position is valid.
    #[must_use]
    pub fn horizontal_position(self) -> bool {
        self.0 & 16 != 0
    }
    /// Absolute vertical position is valid.
    #[must_use]
    pub fn vertical_position(self) -> bool {
        self.0 & 32 != 0
    }
    /// The estimator sees a jump in GNSS.
    #[must_use]
    pub fn gnss_glitch(self) -> bool {
        self.0 & 1024 != 0
    }
}

/// Where the vehicle counts its height from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HomePosition {
    /// Geodetic latitude, degrees.
    pub latitude_deg: f64,
    /// Longitude, degrees.
    pub longitude_deg: f64,
    /// Altitude above mean sea level.
    pub altitude: MslAltitude,
}

/// What a gimbal's yaw counts from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GimbalYaw {
    /// The vehicle's nose.
    FromNose,
    /// True north.
    FromNorth,
}

/// How a gimbal stands.
///
/// The flags that lock roll, pitch or yaw say what the gimbal holds still, not what its quaternion
/// counts from: roll and pitch always count from the horizon. Only a message without either yaw
/// frame flag says its yaw frame by its yaw lock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GimbalDeviceAttitude {
    /// When it held, on the clock of whoever sent it.
    pub boot: BootTime,
    /// Which of the gimbals that hang on the sender: 1 to 6; 0 is the sender itself.
    pub device: u8,
    /// Gimbal axes (forward, right, down) to level axes; roll and pitch from the horizon, yaw as
    /// `yaw` says.
    pub quaternion: UnitQuaternion<f64>,
    /// What yaw counts from.
    pub yaw: GimbalYaw,
    /// Vehicle's nose clockwise from north as the gimbal has it, radians, where it says so.
    pub nose_rad: Option<f64>,
    /// It reports an encoder, software or link fault, or calibrates: the attitude may be anything.
    pub is_faulty: bool,
    /// Turn rates, rad/s, where known.
    pub rate_rad_s: Option<Vector3<f64>>,
}

/// Outcome of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum CommandResult {
    /// Done, or begun.
    Accepted,
    /// Not now; ask again.
    TemporarilyRejected,
    /// Not allowed.
    Denied,
    /// Not understood.
    Unsupported,
    /// Tried, failed.
    Failed,
    /// Under way.
    InProgress,
    /// Given up on request.
    Cancelled,
    /// A refusal of a newer kind, by its number.
    Refused(u8),
}

impl CommandResult {
    fn from_number(number: u8) -> Self {
        match number {
            0 => Self::Accepted,
            1 => Self::TemporarilyRejected,
            2 => Self::Denied,
            3 => Self::Unsupported,
            4 => Self::Failed,
            5 => Self::InProgress,
            6 => Self::Cancelled,
            other => Self::Refused(other),
        }
    }
}

/// Answer to a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CommandAck {
    /// `MAV_CMD` that is answered.
    pub command: u32,
    /// Outcome.
    pub result: CommandResult,
    /// Free for the command to define.
    pub result_param2: i32,
    /// Who had asked.
    pub target: Address,
}

/// A command with a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CommandInt {
    /// `MAV_CMD`.
    pub command: u32,
    /// `MAV_FRAME` of the place; 0 is latitude, longitude, altitude above mean sea level.
    pub frame: u8,
    /// Parameters 1 to 4.
    pub params: [f32; 4],
    /// Latitude in 1e-7 degrees, or as `frame` says.
    pub x: i32,
    /// Longitude in 1e-7 degrees, or as `frame` says.
    pub y: i32,
    /// Altitude in metres, or as `frame` says.
    pub z: f32,
    /// Whom it addresses.
    pub target: Address,
}

/// A command without a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CommandLong {
    /// `MAV_CMD`.
    pub command: u32,
    /// Parameters 1 to 7.
    pub params: [f32; 7],
    /// How often it was sent before.
    pub confirmation: u8,
    /// Whom it addresses.
    pub target: Address,
}

/// How loud a text is, loudest first (RFC 5424).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Severity {
    /// The system is unusable.
    Emergency,
    /// Act now.
    Alert,
    /// A primary system has failed.
    Critical,
    /// A secondary system has failed.
    Error,
    /// May become an error.
    Warning,
    /// Unusual, not wrong.
    Notice,
    /// Normal.
    Info,
    /// For developers.
    Debug,
}

/// A line for people.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StatusText {
    /// How loud.
    pub severity: Severity,
    /// The line; bytes that are no UTF-8 are replaced.
    pub text: String,
}

/// Where a camera's tracked target is; MAVLink's standard word for a located object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraTrackingGeoStatus {
    /// Whether something is tracked.
    pub tracking: bool,
    /// Geodetic latitude of the target, degrees.
    pub latitude_deg: f64,
    /// Longitude of the target, degrees.
    pub longitude_deg: f64,
    /// Altitude of the target above mean sea level.
    pub altitude: MslAltitude,
    /// One sigma, horizontal, metres.
    pub horizontal_sigma_m: Option<f64>,
    /// One sigma, vertical, metres.
    pub vertical_sigma_m: Option<f64>,
    /// Straight line from camera to target, metres.
    pub range_m: Option<f64>,
}

/// How well a radio modem does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RadioStatus {
    /// Signal strength here, in the modem's units; `None` is unknown.
    pub rssi: Option<u8>,
    /// Signal strength at the other end, in the modem's units; `None` is unknown.
    pub remote_rssi: Option<u8>,
    /// Free room in the transmit buffer, percent.
    pub free_buffer_percent: u8,
    /// Packets received with errors.
    pub receive_errors: u16,
}

/// Why a good frame says nothing that may be used.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// Our dialect cannot express it, such as a new enum value.
    #[error("message {message_id} cannot be decoded: {source}")]
    Undecodable {
        /// Which message.
        message_id: u32,
        /// What the dialect said.
        source: ParserError,
    },
    /// Latitude and longitude both 0: what senders write when they have no position.
    #[error("{message} has latitude and longitude 0")]
    NullPosition {
        /// Which message.
        message: &'static str,
    },
    /// No latitude.
    #[error("{message} has latitude {latitude_deg} degrees, allowed is -90 to 90")]
    Latitude {
        /// Which message.
        message: &'static str,
        /// What it said, degrees.
        latitude_deg: f64,
    },
    /// No longitude.
    #[error("{message} has longitude {longitude_deg} degrees, allowed is -180 to 180")]
    Longitude {
        /// Which message.
        message: &'static str,
        /// What it said, degrees.
        longitude_deg: f64,
    },
    /// No altitude that an aircraft or a fire can have.
    #[error("{message} has altitude {altitude_m} m, allowed is {lowest_m} to {highest_m} m")]
    Altitude {
        /// Which message.
        message: &'static str,
        /// What it said, metres.
        altitude_m: f64,
        /// Lowest that is believed, metres.
        lowest_m: f64,
        /// Highest that is believed, metres.
        highest_m: f64,
    },
    /// A number that is not finite.
    #[error("{message} has {field} {value}, which is not finite")]
    NotFinite {
        /// Which message.
        message: &'static str,
        /// Which field.
        field: &'static str,
        /// What stood there.
        value: f64,
    },
    /// Yaw can't count from the nose and from north.
    #[error("{message} sets both yaw frame flags, which is not allowed")]
    TwoYawFrames {
        /// Which message.
        message: &'static str,
    },
    /// No attitude.
    #[error("{message}: {source}")]
    Attitude {
        /// Which message.
        message: &'static str,
        /// Why not.
        source: AttitudeError,
    },
}

impl DecodeError {
    /// Short name, for counters.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Self::Undecodable { .. } => "undecodable",
            Self::NullPosition { .. } => "null_position",
            Self::Latitude { .. } => "latitude",
            Self::Longitude { .. } => "longitude",
            Self::Altitude { .. } => "altitude",
            Self::NotFinite { .. } => "not_finite",
            Self::TwoYawFrames { .. } => "two_yaw_frames",
            Self::Attitude { .. } => "attitude",
        }
    }
}

/// What a frame says.
///
/// # Errors
/// [`DecodeError`], carrying what could not be believed.
pub fn decode(frame: &RawFrame) -> Result<Telemetry, DecodeError> {
    let message_id = frame.message_id;
    match MavMessage::parse(frame.version.into(), message_id, frame.payload()) {
        Ok(message) => translate(&message),
        Err(ParserError::UnknownMessage { .. }) => Ok(Telemetry::Other { message_id }),
        Err(source) => Err(DecodeError::Undecodable { message_id, source }),
    }
}

/// Name of a message, such as `HEARTBEAT`, or `UNKNOWN_<id>` where our dialect has none.
#[must_use]
pub fn message_name(message_id: u32) -> String {
    MavMessage::default_message_from_id(message_id).map_or_else(
        || format!("UNKNOWN_{message_id}"),
        |message| message.message_name().to_owned(),
    )
}

fn translate(message: &MavMessage) -> Result<Telemetry, DecodeError> {
    Ok(match message {
        MavMessage::HEARTBEAT(m) => Telemetry::Heartbeat(heartbeat(m)),
        MavMessage::ATTITUDE_QUATERNION(m) => Telemetry::Attitude(attitude_quaternion(m)?),
        MavMessage::ATTITUDE(m) => Telemetry::Attitude(attitude(m)?),
        MavMessage::GLOBAL_POSITION_INT(m) => Telemetry::GlobalPosition(global_position(m)?),
        MavMessage::GPS_RAW_INT(m) => Telemetry::GpsRaw(gps_raw(m)?),
        MavMessage::GPS2_RAW(m) => Telemetry::Gps2Raw(gps2_raw(m)?),
        MavMessage::SYSTEM_TIME(m) => Telemetry::SystemTime(system_time(m)),
        MavMessage::TIMESYNC(m) => Telemetry::TimeSync(time_sync(m)),
        MavMessage::ESTIMATOR_STATUS(m) => Telemetry::EstimatorStatus(estimator_status(m)),
        MavMessage::HOME_POSITION(m) => Telemetry::HomePosition(home_position(m)?),
        MavMessage::GIMBAL_DEVICE_ATTITUDE_STATUS(m) => {
            Telemetry::GimbalDeviceAttitude(gimbal_attitude(m)?)
        }
        MavMessage::COMMAND_ACK(m) => Telemetry::CommandAck(command_ack(m)),
        MavMessage::COMMAND_INT(m) => Telemetry::CommandInt(command_int(m)),
        MavMessage::COMMAND_LONG(m) => Telemetry::CommandLong(command_long(m)),
        MavMessage::STATUSTEXT(m) => Telemetry::StatusText(status_text(m)),
        MavMessage::CAMERA_TRACKING_GEO_STATUS(m) => {
            Telemetry::CameraTrackingGeoStatus(tracking_status(m)?)
        }
        MavMessage::RADIO_STATUS(m) => Telemetry::RadioStatus(radio_status(m)),
        MavMessage::WIND_COV(m) if m.wind_x.is_finite() && m.wind_y.is_finite() => {
            Telemetry::Wind(wind(m))
        }
        other => Telemetry::Other {
            message_id: other.message_id(),
        },
    })
}

/// North and east on the wire are the air's own motion, so the wind blows towards them.
fn wind(m: &dialect::WIND_COV_DATA) -> WindEstimate {
    let up = if m.wind_z.is_finite() { -m.wind_z } else { 0.0 };
    let variance = f64::from(m.var_horiz);
    WindEstimate {
        towards_enu_m_s: Vector3::new(f64::from(m.wind_y), f64::from(m.wind_x), f64::from(up)),
        horizontal_sigma_m_s: (variance.is_finite() && variance > 0.0).then(|| variance.sqrt()),
    }
}

fn heartbeat(m: &dialect::HEARTBEAT_DATA) -> Heartbeat {
    Heartbeat {
        vehicle_type: m.mavtype as u8,
        autopilot: m.autopilot as u8,
        armed: m
            .base_mode
            .contains(dialect::MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED),
        state: m.system_status as u8,
    }
}

fn attitude_quaternion(
    m: &dialect::ATTITUDE_QUATERNION_DATA,
) -> Result<AttitudeSample, DecodeError> {
    const MESSAGE: &str = "ATTITUDE_QUATERNION";
    let quaternion = [m.q1, m.q2, m.q3, m.q4].map(f64::from);
    Ok(AttitudeSample {
        boot: BootTime::from_ms(m.time_boot_ms),
        attitude: Attitude::from_mavlink_quaternion(quaternion).map_err(|source| {
            DecodeError::Attitude {
                message: MESSAGE,
                source,
            }
        })?,
        rate_rad_s: finite_vector(MESSAGE, "rate", [m.rollspeed, m.pitchspeed, m.yawspeed])?,
        source: AttitudeSource::Quaternion,
    })
}

fn attitude(m: &dialect::ATTITUDE_DATA) -> Result<AttitudeSample, DecodeError> {
    const MESSAGE: &str = "ATTITUDE";
    let angles = finite_vector(MESSAGE, "angle", [m.roll, m.pitch, m.yaw])?;
    Ok(AttitudeSample {
        boot: BootTime::from_ms(m.time_boot_ms),
        attitude: Attitude::from_angles(angles.x, angles.y, angles.z),
        rate_rad_s: finite_vector(MESSAGE, "rate", [m.rollspeed, m.pitchspeed, m.yawspeed])?,
        source: AttitudeSource::Angles,
    })
}

fn global_position(m: &dialect::GLOBAL_POSITION_INT_DATA) -> Result<GlobalPosition, DecodeError> {
    let wire = WirePlace {
        message: "GLOBAL_POSITION_INT",
        lat: m.lat,
        lon: m.lon,
    };
    let (latitude_deg, longitude_deg) = wire.degrees()?;
    let velocity_cm_s = Vector3::new(m.vx, m.vy, m.vz).map(f64::from);
    Ok(GlobalPosition {
        boot: BootTime::from_ms(m.time_boot_ms),
        latitude_deg,
        longitude_deg,
        altitude: wire.altitude(millimetres(m.alt))?,
        above_home_m: millimetres(m.relative_alt),
        velocity_ned_m_s: velocity_cm_s * 0.01,
        heading_rad: (m.hdg <= 36_000).then(|| centidegrees(m.hdg)),
    })
}

fn gps_raw(m: &dialect::GPS_RAW_INT_DATA) -> Result<GpsRaw, DecodeError> {
    WireGps {
        message: "GPS_RAW_INT",
        time_us: m.time_usec,
        fix_type: m.fix_type,
        place: (m.lat, m.lon),
        alt_mm: m.alt,
        alt_ellipsoid_mm: m.alt_ellipsoid,
        accuracy_mm: (m.h_acc, m.v_acc),
        speed_course: (m.vel, m.cog),
        satellites: m.satellites_visible,
    }
    .read()
}

fn gps2_raw(m: &dialect::GPS2_RAW_DATA) -> Result<GpsRaw, DecodeError> {
    WireGps {
        message: "GPS2_RAW",
        time_us: m.time_usec,
        fix_type: m.fix_type,
        place: (m.lat, m.lon),
        alt_mm: m.alt,
        alt_ellipsoid_mm: m.alt_ellipsoid,
        accuracy_mm: (m.h_acc, m.v_acc),
        speed_course: (m.vel, m.cog),
        satellites: m.satellites_visible,
    }
    .read()
}

/// What the messages of all receivers hold.
struct WireGps {
    message: &'static str,
    time_us: u64,
    fix_type: dialect::GpsFixType,
    place: (i32, i32),
    alt_mm: i32,
    alt_ellipsoid_mm: i32,
    accuracy_mm: (u32, u32),
    speed_course: (u16, u16),
    satellites: u8,
}

impl WireGps {
    fn read(&self) -> Result<GpsRaw, DecodeError> {
        let fix = gnss_fix(self.fix_type);
        let (speed_cm_s, course_cdeg) = self.speed_course;
        Ok(GpsRaw {
            time: vehicle_time(self.time_us),
            fix,
            place: if fix.is_3d() {
                Some(self.read_place()?)
            } else {
                None
            },
            horizontal_sigma_m: known_millimetres(self.accuracy_mm.0),
            vertical_sigma_m: known_millimetres(self.accuracy_mm.1),
            ground_speed_m_s: (speed_cm_s != u16::MAX).then(|| f64::from(speed_cm_s) * 0.01),
            course_rad: (course_cdeg <= 36_000).then(|| centidegrees(course_cdeg)),
            satellites: (self.satellites != u8::MAX).then_some(self.satellites),
        })
    }

    fn read_place(&self) -> Result<GnssPlace, DecodeError> {
        let wire = WirePlace {
            message: self.message,
            lat: self.place.0,
            lon: self.place.1,
        };
        let (latitude_deg, longitude_deg) = wire.degrees()?;
        let altitude = wire.altitude(millimetres(self.alt_mm))?;
        // An absent extension reads as 0, so that a receiver exactly on the ellipsoid looks unset too.
        let height = Some(millimetres(self.alt_ellipsoid_mm)).filter(|height_m| {
            *height_m != 0.0 && (height_m - altitude.m()).abs() <= MAX_UNDULATION_M
        });
        Ok(GnssPlace {
            latitude_deg,
            longitude_deg,
            altitude,
            height: height.map(EllipsoidHeight::from_m),
        })
    }
}

fn gnss_fix(fix: dialect::GpsFixType) -> GnssFix {
    use dialect::GpsFixType as Wire;
    match fix {
        Wire::GPS_FIX_TYPE_NO_GPS => GnssFix::None,
        Wire::GPS_FIX_TYPE_NO_FIX => GnssFix::NoFix,
        Wire::GPS_FIX_TYPE_2D_FIX => GnssFix::Fix2d,
        Wire::GPS_FIX_TYPE_3D_FIX => GnssFix::Fix3d,
        Wire::GPS_FIX_TYPE_DGPS | Wire::GPS_FIX_TYPE_STATIC | Wire::GPS_FIX_TYPE_PPP => {
            GnssFix::Dgps
        }
        Wire::GPS_FIX_TYPE_RTK_FLOAT => GnssFix::RtkFloat,
        Wire::GPS_FIX_TYPE_RTK_FIXED => GnssFix::RtkFixed,
    }
}

fn system_time(m: &dialect::SYSTEM_TIME_DATA) -> SystemTime {
    SystemTime {
        boot: BootTime::from_ms(m.time_boot_ms),
        utc: sane_utc(m.time_unix_usec),
        claimed_utc_us: m.time_unix_usec,
    }
}

fn time_sync(m: &dialect::TIMESYNC_DATA) -> TimeSyncMessage {
    TimeSyncMessage {
        tc1_ns: m.tc1,
        ts1_ns: m.ts1,
        target: Address::new(m.target_system, m.target_component),
    }
}

fn estimator_status(m: &dialect::ESTIMATOR_STATUS_DATA) -> EstimatorStatus {
    EstimatorStatus {
        time: vehicle_time(m.time_usec),
        horizontal_sigma_m: known_metres(m.pos_horiz_accuracy),
        vertical_sigma_m: known_metres(m.pos_vert_accuracy),
        flags: EstimatorFlags(m.flags.bits()),
    }
}

fn home_position(m: &dialect::HOME_POSITION_DATA) -> Result<HomePosition, DecodeError> {
    let wire = WirePlace {
        message: "HOME_POSITION",
        lat: m.latitude,
        lon: m.longitude,
    };
    let (latitude_deg, longitude_deg) = wire.degrees()?;
    let altitude = wire.altitude(millimetres(m.altitude))?;
    Ok(HomePosition {
        latitude_deg,
        longitude_deg,
        altitude,
    })
}

fn gimbal_attitude(
    m: &dialect::GIMBAL_DEVICE_ATTITUDE_STATUS_DATA,
) -> Result<GimbalDeviceAttitude, DecodeError> {
    use dialect::GimbalDeviceErrorFlags as Faults;
    use dialect::GimbalDeviceFlags as Flags;
    const MESSAGE: &str = "GIMBAL_DEVICE_ATTITUDE_STATUS";
    let checked = Attitude::from_mavlink_quaternion(m.q.map(f64::from)).map_err(|source| {
        DecodeError::Attitude {
            message: MESSAGE,
            source,
        }
    })?;
    let rates = [
        m.angular_velocity_x,
        m.angular_velocity_y,
        m.angular_velocity_z,
    ];
    // Gimbals from before the two yaw flags say it by their yaw lock.
    let vehicle = m
        .flags
        .contains(Flags::GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME);
    let earth = m
        .flags
        .contains(Flags::GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME);
    let locked = m.flags.contains(Flags::GIMBAL_DEVICE_FLAGS_YAW_LOCK);
    if earth && vehicle {
        return Err(DecodeError::TwoYawFrames { message: MESSAGE });
    }
    let from_north = earth || (locked && !vehicle);
    let faults = Faults::GIMBAL_DEVICE_ERROR_FLAGS_ENCODER_ERROR
        | Faults::GIMBAL_DEVICE_ERROR_FLAGS_SOFTWARE_ERROR
        | Faults::GIMBAL_DEVICE_ERROR_FLAGS_COMMS_ERROR
        | Faults::GIMBAL_DEVICE_ERROR_FLAGS_CALIBRATION_RUNNING;
    Ok(GimbalDeviceAttitude {
        boot: BootTime::from_ms(m.time_boot_ms),
        device: m.gimbal_device_id,
        quaternion: checked.quaternion(),
        yaw: if from_north {
            GimbalYaw::FromNorth
        } else {
            GimbalYaw::FromNose
        },
        // Without a yaw frame flag the field is to be ignored; absent, the extension reads as 0.
        nose_rad: Some(f64::from(m.delta_yaw))
            .filter(|yaw| (earth || vehicle) && yaw.is_finite() && *yaw != 0.0),
        is_faulty: m.failure_flags.intersects(faults),
        rate_rad_s: finite_vector(MESSAGE, "rate", rates).ok(),
    })
}

fn command_ack(m: &dialect::COMMAND_ACK_DATA) -> CommandAck {
    CommandAck {
        command: m.command as u32,
        result: CommandResult::from_number(m.result as u8),
        result_param2: m.result_param2,
        target: Address::new(m.target_system, m.target_component),
    }
}

fn command_int(m: &dialect::COMMAND_INT_DATA) -> CommandInt {
    CommandInt {
        command: m.command as u32,
        frame: m.frame as u8,
        params: [m.param1, m.param2, m.param3, m.param4],
        x: m.x,
        y: m.y,
        z: m.z,
        target: Address::new(m.target_system, m.target_component),
    }
}

fn command_long(m: &dialect::COMMAND_LONG_DATA) -> CommandLong {
    CommandLong {
        command: m.command as u32,
        params: [
            m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7,
        ],
        confirmation: m.confirmation,
        target: Address::new(m.target_system, m.target_component),
    }
}

fn status_text(m: &dialect::STATUSTEXT_DATA) -> StatusText {
    let line = m.text.split(|byte| *byte == 0).next().unwrap_or_default();
    StatusText {
        severity: severity(m.severity),
        text: String::from_utf8_lossy(line).into_owned(),
    }
}

fn severity(severity: dialect::MavSeverity) -> Severity {
    use dialect::MavSeverity as Wire;
    match severity {
        Wire::MAV_SEVERITY_EMERGENCY => Severity::Emergency,
        Wire::MAV_SEVERITY_ALERT => Severity::Alert,
        Wire::MAV_SEVERITY_CRITICAL => Severity::Critical,
        Wire::MAV_SEVERITY_ERROR => Severity::Error,
        Wire::MAV_SEVERITY_WARNING => Severity::Warning,
        Wire::MAV_SEVERITY_NOTICE => Severity::Notice,
        Wire::MAV_SEVERITY_INFO => Severity::Info,
        Wire::MAV_SEVERITY_DEBUG => Severity::Debug,
    }
}

fn tracking_status(
    m: &dialect::CAMERA_TRACKING_GEO_STATUS_DATA,
) -> Result<CameraTrackingGeoStatus, DecodeError> {
    use dialect::CameraTrackingStatusFlags as Flags;
    let wire = WirePlace {
        message: "CAMERA_TRACKING_GEO_STATUS",
        lat: m.lat,
        lon: m.lon,
    };
    let (latitude_deg, longitude_deg) = wire.degrees()?;
    Ok(CameraTrackingGeoStatus {
        tracking: m
            .tracking_status
            .contains(Flags::CAMERA_TRACKING_STATUS_FLAGS_ACTIVE),
        latitude_deg,
        longitude_deg,
        altitude: wire.altitude(f64::from(m.alt))?,
        horizontal_sigma_m: known_metres(m.h_acc),
        vertical_sigma_m: known_metres(m.v_acc),
        range_m: known_metres(m.dist),
    })
}

fn radio_status(m: &dialect::RADIO_STATUS_DATA) -> RadioStatus {
    let known = |rssi: u8| (rssi != u8::MAX).then_some(rssi);
    RadioStatus {
        rssi: known(m.rssi),
        remote_rssi: known(m.remrssi),
        free_buffer_percent: m.txbuf,
        receive_errors: m.rxerrors,
    }
}

/// PX4 and mavros take a UTC for set above this (13 February 2009).
const UTC_FROM_US: u64 = 1_234_567_890_000_000;
/// 1 January 2100: no vehicle of ours flies then, but autopilots have claimed the year 2908.
const UTC_BEFORE_US: u64 = 4_102_444_800_000_000;
/// The Dead Sea's shore lies at -440 m; nothing that flies or burns is much lower.
const LOWEST_M: f64 = -600.0;
/// Where the air ends.
const HIGHEST_M: f64 = 100_000.0;
/// The geoid leaves the ellipsoid by at most 107 m.
const MAX_UNDULATION_M: f64 = 120.0;

fn sane_utc(unix_us: u64) -> Option<ServiceTime> {
    if !(UTC_FROM_US..UTC_BEFORE_US).contains(&unix_us) {
        return None;
    }
    i64::try_from(unix_us)
        .ok()
        .map(|us| ServiceTime::from_unix_ns(us * 1_000))
}

fn vehicle_time(time_us: u64) -> VehicleTime {
    match sane_utc(time_us) {
        Some(utc) => VehicleTime::Utc(utc),
        None => VehicleTime::Boot(BootTime::from_us(time_us)),
    }
}

fn millimetres(mm: i32) -> f64 {
    f64::from(mm) * 1e-3
}

fn centidegrees(cdeg: u16) -> f64 {
    (f64::from(cdeg) * 0.01).to_radians()
}

/// 0 is an absent extension and `u32::MAX` a fill: both are unknown.
fn known_millimetres(mm: u32) -> Option<f64> {
    (mm != 0 && mm != u32::MAX).then(|| f64::from(mm) * 1e-3)
}

fn known_metres(metres: f32) -> Option<f64> {
    (metres.is_finite() && metres > 0.0).then(|| f64::from(metres))
}

fn finite_vector(
    message: &'static str,
    field: &'static str,
    values: [f32; 3],
) -> Result<Vector3<f64>, DecodeError> {
    let values = values.map(f64::from);
    match values.into_iter().find(|value| !value.is_finite()) {
        Some(value) => Err(DecodeError::NotFinite {
            message,
            field,
            value,
        }),
        None => Ok(Vector3::from(values)),
    }
}

struct WirePlace {
    message: &'static str,
    lat: i32,
    lon: i32,
}

impl WirePlace {
    fn degrees(&self) -> Result<(f64, f64), DecodeError> {
        let message = self.message;
        let (latitude_deg, longitude_deg) =
            (f64::from(self.lat) * 1e-7, f64::from(self.lon) * 1e-7);
        if self.lat == 0 && self.lon == 0 {
            return Err(DecodeError::NullPosition { message });
        }
        if latitude_deg.abs() > 90.0 {
            return Err(DecodeError::Latitude {
                message,
                latitude_deg,
            });
        }
        if longitude_deg.abs() > 180.0 {
            return Err(DecodeError::Longitude {
                message,
                longitude_deg,
            });
        }
        Ok((latitude_deg, longitude_deg))
    }

    fn altitude(&self, altitude_m: f64) -> Result<MslAltitude, DecodeError> {
        if (LOWEST_M..=HIGHEST_M).contains(&altitude_m) {
            return Ok(MslAltitude::from_m(altitude_m));
        }
        let (message, lowest_m, highest_m) = (self.message, LOWEST_M, HIGHEST_M);
        Err(DecodeError::Altitude {
            message,
            altitude_m,
            lowest_m,
            highest_m,
        })
    }
}

/// One received frame and what it says.
#[derive(Debug)]
pub struct Received {
    /// The bytes as they came, for the recording.
    pub frame: RawFrame,
    /// What they say.
    pub telemetry: Result<Telemetry, DecodeError>,
}

impl crate::wire::FrameReader {
    /// The next frame together with what it says; counts what cannot be decoded.
    pub fn next_received(&mut self) -> Option<Received> {
        let frame = self.next_frame()?;
        let telemetry = decode(&frame);
        if matches!(telemetry, Err(DecodeError::Undecodable { .. })) {
            self.count_undecodable();
        }
        Some(Received { frame, telemetry })
    }
}

impl Received {
    /// Sender's system.
    #[must_use]
    pub fn system(&self) -> SystemId {
        self.frame.system
    }
    /// Sender's component.
    #[must_use]
    pub fn component(&self) -> ComponentId {
        self.frame.component
    }
}
