//! Messages to images, calibrations and frames: the contract's topics, read strictly.

use super::blocks::RawMessage;
use super::{EncodedImage, ImageEncoding};
use crate::assess::spectrum::Spectrum;
use bytes::Bytes;
use emberfix_calib::{Camera, Eye};
use emberfix_frames::ServiceTime;
use foxglove::Decode;
use foxglove::messages::{CameraCalibration, CompressedImage, RawImage, Timestamp};

/// The contract's topics.
pub(crate) mod topic {
    pub const LEFT_IMAGE: &str = "/stereo/left/image";
    pub const RIGHT_IMAGE: &str = "/stereo/right/image";
    pub const LEFT_CALIBRATION: &str = "/stereo/left/calibration";
    pub const RIGHT_CALIBRATION: &str = "/stereo/right/calibration";
    pub const MAVLINK: &str = "/mavlink/raw";
    pub const SPECTROMETER: &str = "/spectrometer";
    pub const ACTIONS: &str = "/operator/actions";
}

/// What a message is to us, in the order in which messages of one log time count.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Role {
    Calibration(EyeRank),
    Mavlink,
    Action,
    Spectrometer,
    Image(EyeRank),
    Other,
}

/// [`Eye`] with an order: left first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum EyeRank {
    Left,
    Right,
}

impl From<EyeRank> for Eye {
    fn from(rank: EyeRank) -> Self {
        match rank {
            EyeRank::Left => Self::Left,
            EyeRank::Right => Self::Right,
        }
    }
}

impl Role {
    pub fn of(topic: &str) -> Self {
        match topic {
            topic::LEFT_IMAGE => Self::Image(EyeRank::Left),
            topic::RIGHT_IMAGE => Self::Image(EyeRank::Right),
            topic::LEFT_CALIBRATION => Self::Calibration(EyeRank::Left),
            topic::RIGHT_CALIBRATION => Self::Calibration(EyeRank::Right),
            topic::MAVLINK => Self::Mavlink,
            topic::SPECTROMETER => Self::Spectrometer,
            topic::ACTIONS => Self::Action,
            _ => Self::Other,
        }
    }
}

/// Why a message of one of our topics is of no use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Refusal {
    /// Not what its schema says, or a schema that the topic does not have.
    Unreadable,
    /// No timestamp.
    Unstamped,
    /// An image format that we don't read.
    UnknownFormat,
}

/// Reads an image of one eye.
pub(crate) fn image(message: &RawMessage) -> Result<EncodedImage, Refusal> {
    match message.channel.schema.as_str() {
        "foxglove.CompressedImage" => compressed(message.data.clone()),
        "foxglove.RawImage" => raw(message.data.clone()),
        _ => Err(Refusal::Unreadable),
    }
}

fn compressed(data: Bytes) -> Result<EncodedImage, Refusal> {
    let image = CompressedImage::decode(data).map_err(|_| Refusal::Unreadable)?;
    let encoding = match image.format.as_str() {
        "jpeg" | "jpg" => ImageEncoding::Jpeg,
        "png" => ImageEncoding::Png,
        _ => return Err(Refusal::UnknownFormat),
    };
    Ok(EncodedImage {
        encoding,
        at: stamp(image.timestamp)?,
        bytes: image.data,
    })
}

fn raw(data: Bytes) -> Result<EncodedImage, Refusal> {
    let image = RawImage::decode(data).map_err(|_| Refusal::Unreadable)?;
    let at = stamp(image.timestamp)?;
    let RawImage {
        encoding,
        width,
        height,
        step,
        data: bytes,
        ..
    } = image;
    Ok(EncodedImage {
        encoding: ImageEncoding::Raw {
            encoding,
            width,
            height,
            step,
        },
        bytes,
        at,
    })
}

fn stamp(timestamp: Option<Timestamp>) -> Result<ServiceTime, Refusal> {
    let ns = timestamp
        .map(|t| t.total_nanos())
        .filter(|ns| *ns > 0)
        .ok_or(Refusal::Unstamped)?;
    i64::try_from(ns)
        .map(ServiceTime::from_unix_ns)
        .map_err(|_| Refusal::Unstamped)
}

/// A calibration as the stream states it. R and P are not here: we compute them.
#[derive(Debug, Clone, PartialEq)]
pub struct StatedCalibration {
    /// Columns, rows.
    pub image_size_px: (u32, u32),
    /// Name of the distortion model (`plumb_bob`, ..).
    pub distortion_model: String,
    /// Distortion terms in the model's order.
    pub distortion: Vec<f64>,
    /// Camera matrix, row-major 3x3, pixels.
    pub camera_matrix: [f64; 9],
}

/// Where a stated calibration and the rig disagree; the rig counts.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("stated calibration: {what} is {stated}, the rig says {rig}")]
pub struct CalibrationMismatch {
    /// Which value.
    pub what: &'static str,
    /// What the stream says.
    pub stated: String,
    /// What the rig says.
    pub rig: String,
}

/// Largest difference of a K term that is rounding, pixels.
const K_LIMIT_PX: f64 = 0.01;
/// Largest difference of a distortion term that is rounding.
const D_LIMIT: f64 = 1e-6;

impl StatedCalibration {
    /// Holds it against the rig's camera: size, K within 0.01 px, D within 1e-6.
    ///
    /// # Errors
    /// The first [`CalibrationMismatch`].
    pub fn check(&self, camera: &Camera) -> Result<(), CalibrationMismatch> {
        let mismatch =
            |what, stated: String, rig: String| CalibrationMismatch { what, stated, rig };
        if self.image_size_px != camera.image_size_px {
            let (stated, rig) = (self.image_size_px, camera.image_size_px);
            return Err(mismatch(
                "image size",
                format!("{stated:?}"),
                format!("{rig:?}"),
            ));
        }
        let rig_k = camera_matrix(camera);
        if !close(&self.camera_matrix, &rig_k, K_LIMIT_PX) {
            let stated = format!("{:?}", self.camera_matrix);
            return Err(mismatch("K", stated, format!("{rig_k:?}")));
        }
        if !close(&self.distortion, &camera.distortion, D_LIMIT) {
            let stated = format!("{} {:?}", self.distortion_model, self.distortion);
            return Err(mismatch(
                "D",
                stated,
                format!("plumb_bob {:?}", camera.distortion),
            ));
        }
        Ok(())
    }
}

/// The rig camera's K, row-major.
pub(crate) fn camera_matrix(camera: &Camera) -> [f64; 9] {
    let ((fx, fy), (cx, cy)) = (camera.focal_px, camera.principal_point_px);
    [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
}

/// Equal within `limit`, missing terms being zero. Not-a-number is never close.
fn close(stated: &[f64], rig: &[f64], limit: f64) -> bool {
    let term = |terms: &[f64], i: usize| terms.get(i).copied().unwrap_or(0.0);
    (0..stated.len().max(rig.len())).all(|i| (term(stated, i) - term(rig, i)).abs() <= limit)
}

#[derive(serde::Deserialize)]
struct Reading {
    wavelengths_nm: Vec<f64>,
    intensity: Vec<f64>,
}

/// Reads a spectrometer's JSON; its publish time is mid-integration.
pub(crate) fn spectrum(message: &RawMessage) -> Result<Spectrum, Refusal> {
    if message.channel.message_encoding != "json" {
        return Err(Refusal::Unreadable);
    }
    let reading: Reading =
        serde_json::from_slice(&message.data).map_err(|_| Refusal::Unreadable)?;
    let at = i64::try_from(message.publish_time_ns)
        .ok()
        .filter(|ns| *ns > 0)
        .map(ServiceTime::from_unix_ns)
        .ok_or(Refusal::Unstamped)?;
    Spectrum::new(at, reading.wavelengths_nm, reading.intensity).map_err(|_| Refusal::Unreadable)
}

/// Reads a calibration.
pub(crate) fn calibration(message: &RawMessage) -> Result<StatedCalibration, Refusal> {
    if message.channel.schema != "foxglove.CameraCalibration" {
        return Err(Refusal::Unreadable);
    }
    let stated =
        CameraCalibration::decode(message.data.clone()).map_err(|_| Refusal::Unreadable)?;
    let camera_matrix = stated.k.try_into().map_err(|_| Refusal::Unreadable)?;
    Ok(StatedCalibration {
        image_size_px: (stated.width, stated.height),
        distortion_model: stated.distortion_model,
        distortion: stated.d,
        camera_matrix,
    })
}
