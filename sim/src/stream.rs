//! Stereo pairs, calibrations and MAVLink frames as MCAP: the form of a live camera and of a
//! recording alike ("Recording" in the contracts).

use emberfix_calib::{Camera, Eye, Rig};
use emberfix_frames::ServiceTime;
use foxglove::bytes::Bytes;
use foxglove::messages::{CameraCalibration, CompressedImage, Timestamp};
use foxglove::{Encode, Schema};
use mcap::records::MessageHeader;
use mcap::{WriteOptions, Writer};
use std::collections::BTreeMap;
use std::io::{Seek, Write};

/// Why a stream could not be written.
#[derive(Debug, thiserror::Error)]
pub enum StreamError {
    /// The MCAP writer, or the file or socket beneath it.
    #[error("MCAP stream: {source}")]
    Mcap {
        /// What it said.
        #[from]
        source: mcap::McapError,
    },
    /// A Foxglove message could not be encoded.
    #[error("{message} could not be encoded: {reason}")]
    Encode {
        /// Which message.
        message: &'static str,
        /// What the encoder said.
        reason: String,
    },
}

/// Both eyes' images of one moment, encoded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EncodedPair {
    /// Mid-exposure by the camera's own stamp, on the service clock.
    pub stamped: ServiceTime,
    /// When it reaches the service.
    pub arrives: ServiceTime,
    /// Left image, JPEG.
    pub left: Vec<u8>,
    /// Right image, JPEG.
    pub right: Vec<u8>,
    /// Spectrometer reading of the same moment, JSON.
    pub spectrum: Option<Vec<u8>>,
}

/// Writes the contract's input topics.
pub struct StereoWriter<W: Write + Seek> {
    writer: Writer<W>,
    images: [u16; 2],
    calibrations: [u16; 2],
    mavlink: Option<u16>,
    /// Declared with the first reading.
    spectrometer: Option<u16>,
    sequence: u32,
}

const EYES: [Eye; 2] = [Eye::Left, Eye::Right];

fn name(eye: Eye) -> &'static str {
    match eye {
        Eye::Left => "left",
        Eye::Right => "right",
    }
}

impl<W: Write + Seek> StereoWriter<W> {
    /// A stream of pairs; with `mavlink`, also of MAVLink frames.
    ///
    /// # Errors
    /// [`StreamError`] when the destination refuses bytes.
    pub fn new(destination: W, options: WriteOptions, mavlink: bool) -> Result<Self, StreamError> {
        let mut writer = options.library("emberfix-sim").create(destination)?;
        let image = add_schema(&mut writer, CompressedImage::get_schema())?;
        let calibration = add_schema(&mut writer, CameraCalibration::get_schema())?;
        let mut channel = |eye, part: &str, schema| {
            let topic = format!("/stereo/{}/{part}", name(eye));
            writer.add_channel(schema, &topic, "protobuf", &BTreeMap::new())
        };
        let images = [
            channel(Eye::Left, "image", image)?,
            channel(Eye::Right, "image", image)?,
        ];
        let calibrations = [
            channel(Eye::Left, "calibration", calibration)?,
            channel(Eye::Right, "calibration", calibration)?,
        ];
        let mavlink = if mavlink {
            Some(writer.add_channel(0, "/mavlink/raw", "mavlink", &BTreeMap::new())?)
        } else {
            None
        };
        Ok(Self {
            writer,
            images,
            calibrations,
            mavlink,
            spectrometer: None,
            sequence: 0,
        })
    }

    /// Both eyes' calibrations.
    ///
    /// # Errors
    /// [`StreamError`] when the destination refuses bytes.
    pub fn write_calibrations(&mut self, rig: &Rig, at: ServiceTime) -> Result<(), StreamError> {
        for (channel, eye) in self.calibrations.into_iter().zip(EYES) {
            let bytes = encode("foxglove.CameraCalibration", &calibration(rig, eye, at))?;
            self.write(channel, at, at, &bytes)?;
        }
        Ok(())
    }

    /// One pair.
    ///
    /// # Errors
    /// [`StreamError`] when the destination refuses bytes.
    pub fn write_pair(&mut self, pair: EncodedPair) -> Result<(), StreamError> {
        let EncodedPair {
            stamped,
            arrives,
            left,
            right,
            spectrum,
        } = pair;
        if let Some(spectrum) = spectrum {
            let channel = self.spectrometer()?;
            self.write(channel, arrives, stamped, &spectrum)?;
        }
        for ((channel, eye), jpeg) in self.images.into_iter().zip(EYES).zip([left, right]) {
            let image = CompressedImage {
                timestamp: Some(timestamp(stamped)),
                frame_id: format!("stereo_{}_optical", name(eye)),
                data: Bytes::from(jpeg),
                format: "jpeg".to_owned(),
            };
            self.write(
                channel,
                arrives,
                stamped,
                &encode("foxglove.CompressedImage", &image)?,
            )?;
        }
        Ok(())
    }

    fn spectrometer(&mut self) -> Result<u16, StreamError> {
        if let Some(channel) = self.spectrometer {
            return Ok(channel);
        }
        let channel = self
            .writer
            .add_channel(0, "/spectrometer", "json", &BTreeMap::new())?;
        self.spectrometer = Some(channel);
        Ok(channel)
    }

    /// One MAVLink frame, the bytes as they came. Dropped when the stream carries none.
    ///
    /// # Errors
    /// [`StreamError`] when the destination refuses bytes.
    pub fn write_mavlink(&mut self, arrives: ServiceTime, frame: &[u8]) -> Result<(), StreamError> {
        match self.mavlink {
            Some(channel) => self.write(channel, arrives, arrives, frame),
            None => Ok(()),
        }
    }

    /// Hands everything so far to the destination.
    ///
    /// # Errors
    /// [`StreamError`] when the destination refuses bytes.
    pub fn flush(&mut self) -> Result<(), StreamError> {
        Ok(self.writer.flush()?)
    }

    /// Ends the stream with its summary.
    ///
    /// # Errors
    /// [`StreamError`] when the destination refuses bytes.
    pub fn finish(mut self) -> Result<W, StreamError> {
        self.writer.finish()?;
        Ok(self.writer.into_inner())
    }

    fn write(
        &mut self,
        channel_id: u16,
        log: ServiceTime,
        publish: ServiceTime,
        data: &[u8],
    ) -> Result<(), StreamError> {
        let header = MessageHeader {
            channel_id,
            sequence: self.sequence,
            log_time: log.unix_ns_u64(),
            publish_time: publish.unix_ns_u64(),
        };
        self.sequence = self.sequence.wrapping_add(1);
        Ok(self.writer.write_to_known_channel(&header, data)?)
    }
}

/// Options of a finished recording: chunks for random access, nothing compressed (JPEG is already).
#[must_use]
pub fn recording_options() -> WriteOptions {
    WriteOptions::new().compression(None)
}

/// Options of a live stream: nothing waits for a chunk to fill, nothing is written back.
#[must_use]
pub fn live_options() -> WriteOptions {
    WriteOptions::new()
        .compression(None)
        .use_chunks(false)
        .disable_seeking(true)
}

fn add_schema<W: Write + Seek>(
    writer: &mut Writer<W>,
    schema: Option<Schema>,
) -> Result<u16, StreamError> {
    let schema = schema.ok_or(StreamError::Encode {
        message: "foxglove schema",
        reason: "the message type has none".to_owned(),
    })?;
    Ok(writer.add_schema(&schema.name, &schema.encoding, &schema.data)?)
}

fn encode<M: Encode>(message: &'static str, value: &M) -> Result<Vec<u8>, StreamError> {
    let mut bytes = Vec::with_capacity(value.encoded_len().unwrap_or(0));
    value
        .encode(&mut bytes)
        .map_err(|error| StreamError::Encode {
            message,
            reason: error.to_string(),
        })?;
    Ok(bytes)
}

fn timestamp(at: ServiceTime) -> Timestamp {
    let ns = at.unix_ns_u64();
    let seconds = u32::try_from(ns / 1_000_000_000).unwrap_or(u32::MAX);
    Timestamp::new(seconds, (ns % 1_000_000_000) as u32)
}

fn calibration(rig: &Rig, eye: Eye, at: ServiceTime) -> CameraCalibration {
    let camera = rig.camera(eye);
    CameraCalibration {
        timestamp: Some(timestamp(at)),
        frame_id: format!("stereo_{}_optical", name(eye)),
        width: camera.image_size_px.0,
        height: camera.image_size_px.1,
        distortion_model: "plumb_bob".to_owned(),
        d: camera.distortion.to_vec(),
        k: intrinsics(camera).to_vec(),
        r: rotation(rig, eye),
        p: projection(rig, eye),
    }
}

#[rustfmt::skip]
fn intrinsics(camera: &Camera) -> [f64; 9] {
    let ((fx, fy), (cx, cy)) = (camera.focal_px, camera.principal_point_px);
    [
        fx, 0.0, cx,
        0.0, fy, cy,
        0.0, 0.0, 1.0,
    ]
}

fn rotation(rig: &Rig, eye: Eye) -> Vec<f64> {
    rig.rectification()
        .rectified_from_raw(eye)
        .transpose()
        .iter()
        .copied()
        .collect()
}

/// In the right eye's fourth column stands `-f b`, as in ROS' `CameraInfo`.
#[rustfmt::skip]
fn projection(rig: &Rig, eye: Eye) -> Vec<f64> {
    let rectified = rig.rectification();
    let (f, (cx, cy)) = (rectified.focal_px(), rectified.principal_point_px());
    let (cx, shift) = match eye {
        Eye::Left => (cx, 0.0),
        Eye::Right => (cx - rectified.infinity_disparity_px(), -f * rig.baseline_m()),
    };
    vec![
        f, 0.0, cx, shift,
        0.0, f, cy, 0.0,
        0.0, 0.0, 1.0, 0.0,
    ]
}
