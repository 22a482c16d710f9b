//! The writing itself, in the caller's thread: same calls, same bytes.

use super::convert::{self, ImageMessage};
use super::{BodyPose, ChunkCompression, RecordError, RecordOptions, UavFix, schemas};
use crate::alarm::{Action, Alarm};
use crate::assess::spectrum::Spectrum;
use crate::detect::Detection;
use crate::ingest::{EncodedImage, StereoPair};
use emberfix_calib::{Eye, Rig};
use emberfix_frames::{ServiceTime, SignedDuration, Stamped};
use foxglove::Encode;
use foxglove::messages::{
    CameraCalibration, CompressedImage, FrameTransform, GeoJson, ImageAnnotations, LocationFix,
    RawImage,
};
use mcap::records::MessageHeader;
use mcap::write::{Metadata, NoSeek};
use mcap::{Compression, WriteOptions, Writer};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

/// A chunk ends after this much log time.
const CHUNK_SPAN: SignedDuration = SignedDuration::from_secs(1);
/// A chunk ends after this many bytes.
const CHUNK_BYTES: u64 = 4 << 20;

const LEFT_IMAGE: &str = "/stereo/left/image";
const RIGHT_IMAGE: &str = "/stereo/right/image";
const LEFT_CALIBRATION: &str = "/stereo/left/calibration";
const RIGHT_CALIBRATION: &str = "/stereo/right/calibration";
const MAVLINK: &str = "/mavlink/raw";
const SPECTROMETER: &str = "/spectrometer";
const UAV_FIX: &str = "/uav/fix";
const TF: &str = "/tf";
const DETECTIONS: &str = "/fire/detections";
const FIXES: &str = "/fire/fixes";
const ALARMS: &str = "/fire/alarms";
const ALARMS_GEOJSON: &str = "/fire/alarms/geojson";
const ACTIONS: &str = "/operator/actions";

/// A recording being written. See the module for times, durability and topics.
pub struct Tape {
    path: PathBuf,
    rig: Rig,
    writer: Writer<NoSeek<BufWriter<File>>>,
    /// The same file, for syncing.
    file: File,
    channels: BTreeMap<(&'static str, String), Track>,
    /// Log time at which the open chunk began, and its bytes.
    chunk: Option<(ServiceTime, u64)>,
    calibrated: bool,
}

/// A channel, and how many messages it has.
#[derive(Debug, Clone, Copy)]
struct Track {
    id: u16,
    messages: u32,
}

/// One message, all but its bytes.
struct Label<'a> {
    topic: &'static str,
    encoding: &'static str,
    /// Name, encoding, data; none for `/mavlink/raw`.
    schema: Option<(&'a str, &'static str, &'a [u8])>,
    logged: ServiceTime,
    published: ServiceTime,
}

impl Tape {
    /// Creates the file, or refuses to overwrite one.
    ///
    /// # Errors
    /// [`RecordError::Io`] when the file is there already or can't be created.
    pub fn create(path: &Path, rig: &Rig, options: &RecordOptions) -> Result<Self, RecordError> {
        let io = |source| RecordError::Io {
            path: path.to_owned(),
            source,
        };
        Self::on(File::create_new(path).map_err(io)?, path, rig, options)
    }

    /// Writes to an opened, empty file.
    pub(super) fn on(
        file: File,
        path: &Path,
        rig: &Rig,
        options: &RecordOptions,
    ) -> Result<Self, RecordError> {
        let io = |source| RecordError::Io {
            path: path.to_owned(),
            source,
        };
        let syncing = file.try_clone().map_err(io)?;
        let compression = match options.compression {
            ChunkCompression::Lz4 => Some(Compression::Lz4),
            ChunkCompression::None => None,
        };
        let mcap_options = WriteOptions::new()
            .library(concat!("emberfix ", env!("CARGO_PKG_VERSION")))
            .compression(compression)
            .compression_threads(0)
            .chunk_size(None)
            // Chunks reach the file whole, with their true length: a torn file stays readable.
            .disable_seeking(true);
        let write = |source| RecordError::Write {
            path: path.to_owned(),
            source,
        };
        let mut writer = mcap_options
            .create(NoSeek::new(BufWriter::new(file)))
            .map_err(write)?;
        let mut metadata = options.metadata.clone();
        metadata.insert("rig".to_owned(), rig.name().to_owned());
        let metadata = Metadata {
            name: "emberfix".to_owned(),
            metadata,
        };
        writer.write_metadata(&metadata).map_err(write)?;
        Ok(Self {
            path: path.to_owned(),
            rig: rig.clone(),
            writer,
            file: syncing,
            channels: BTreeMap::new(),
            chunk: None,
            calibrated: false,
        })
    }

    /// A pair as it came; the rig's calibrations before the first one.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn write_pair(&mut self, pair: &Stamped<StereoPair>) -> Result<(), RecordError> {
        let arrived = pair.value.arrived;
        if !self.calibrated {
            self.calibrated = true;
            for (eye, topic) in [
                (Eye::Left, LEFT_CALIBRATION),
                (Eye::Right, RIGHT_CALIBRATION),
            ] {
                let message = convert::calibration(&self.rig, eye, pair.at);
                self.protobuf::<CameraCalibration>(topic, &message, arrived, pair.at)?;
            }
        }
        for spectrum in &pair.value.spectra {
            self.spectrum(spectrum, arrived)?;
        }
        self.image(LEFT_IMAGE, Eye::Left, &pair.value.left, arrived)?;
        match &pair.value.right {
            Some(right) => self.image(RIGHT_IMAGE, Eye::Right, right, arrived),
            None => Ok(()),
        }
    }

    /// One MAVLink frame, the bytes as they came.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn write_mavlink(&mut self, arrived: ServiceTime, frame: &[u8]) -> Result<(), RecordError> {
        let label = Label {
            topic: MAVLINK,
            encoding: "mavlink",
            schema: None,
            logged: arrived,
            published: arrived,
        };
        self.put(&label, frame)
    }

    /// Where we took the aircraft to be.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn write_uav_fix(&mut self, at: ServiceTime, fix: &UavFix) -> Result<(), RecordError> {
        self.protobuf::<LocationFix>(UAV_FIX, &convert::location_fix(at, fix), at, at)
    }

    /// How airframe and left camera stood.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn write_body_pose(&mut self, at: ServiceTime, pose: &BodyPose) -> Result<(), RecordError> {
        for transform in convert::transforms(at, pose, &self.rig) {
            self.protobuf::<FrameTransform>(TF, &transform, at, at)?;
        }
        Ok(())
    }

    /// What was detected in the left image of `at`.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn write_detections(
        &mut self,
        at: ServiceTime,
        detections: &[Detection],
    ) -> Result<(), RecordError> {
        let annotations = convert::annotations(at, detections);
        self.protobuf::<ImageAnnotations>(DETECTIONS, &annotations, at, at)
    }

    /// One sighting's fix, a GeoJSON Feature.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn write_fix_json(
        &mut self,
        at: ServiceTime,
        fix: &serde_json::Value,
    ) -> Result<(), RecordError> {
        self.json(FIXES, ("emberfix.Fix", schemas::FIX), fix, at)
    }

    /// An alarm; the file is synced after it.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn write_alarm(&mut self, at: ServiceTime, alarm: &Alarm) -> Result<(), RecordError> {
        let feature = alarm.to_geojson();
        self.json(ALARMS, ("emberfix.Alarm", schemas::ALARM), &feature, at)?;
        let geojson = GeoJson {
            geojson: feature.to_string(),
        };
        self.protobuf::<GeoJson>(ALARMS_GEOJSON, &geojson, at, at)?;
        self.sync()
    }

    /// Ends the chunk: everything so far is in the file.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn flush(&mut self) -> Result<(), RecordError> {
        self.chunk = None;
        self.writer.flush().map_err(|source| self.failed(source))
    }

    /// Ends the chunk and asks the disk to keep it.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn sync(&mut self) -> Result<(), RecordError> {
        self.flush()?;
        let synced = self.file.sync_data();
        synced.map_err(|source| RecordError::Io {
            path: self.path.clone(),
            source,
        })
    }

    /// Writes index and summary, and syncs.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn finish(mut self) -> Result<(), RecordError> {
        self.writer.finish().map_err(|source| self.failed(source))?;
        let synced = self.file.sync_all();
        synced.map_err(|source| RecordError::Io {
            path: self.path.clone(),
            source,
        })
    }

    /// What an operator did; the file is synced with the next alarm.
    ///
    /// # Errors
    /// [`RecordError`].
    pub fn write_action(&mut self, at: ServiceTime, action: &Action) -> Result<(), RecordError> {
        let value = serde_json::json!(action);
        self.json(ACTIONS, ("emberfix.Action", schemas::ACTION), &value, at)
    }

    /// A reading as it came, before the pair that it belongs to.
    fn spectrum(&mut self, spectrum: &Spectrum, arrived: ServiceTime) -> Result<(), RecordError> {
        let value = serde_json::json!({
            "wavelengths_nm": spectrum.wavelengths_nm(),
            "intensity": spectrum.intensity(),
        });
        let bytes =
            serde_json::to_vec(&value).map_err(|error| self.unencodable(SPECTROMETER, &error))?;
        let schema = (
            "emberfix.Spectrum",
            "jsonschema",
            schemas::SPECTRUM.as_bytes(),
        );
        let label = Label {
            topic: SPECTROMETER,
            encoding: "json",
            schema: Some(schema),
            logged: arrived,
            published: spectrum.at,
        };
        self.put(&label, &bytes)
    }

    fn image(
        &mut self,
        topic: &'static str,
        eye: Eye,
        image: &EncodedImage,
        arrived: ServiceTime,
    ) -> Result<(), RecordError> {
        match convert::image(eye, image) {
            ImageMessage::Compressed(message) => {
                self.protobuf::<CompressedImage>(topic, &message, arrived, image.at)
            }
            ImageMessage::Raw(message) => {
                self.protobuf::<RawImage>(topic, &message, arrived, image.at)
            }
        }
    }

    fn protobuf<T: Encode>(
        &mut self,
        topic: &'static str,
        message: &T,
        logged: ServiceTime,
        published: ServiceTime,
    ) -> Result<(), RecordError> {
        let mut bytes = Vec::with_capacity(message.encoded_len().unwrap_or_default());
        message
            .encode(&mut bytes)
            .map_err(|error| self.unencodable(topic, &error))?;
        let schema = T::get_schema();
        let schema = schema
            .as_ref()
            .map(|schema| (&*schema.name, "protobuf", &*schema.data));
        self.put(
            &Label {
                topic,
                encoding: "protobuf",
                schema,
                logged,
                published,
            },
            &bytes,
        )
    }

    fn json(
        &mut self,
        topic: &'static str,
        (name, schema): (&str, &str),
        value: &serde_json::Value,
        at: ServiceTime,
    ) -> Result<(), RecordError> {
        let bytes = serde_json::to_vec(value).map_err(|error| self.unencodable(topic, &error))?;
        let schema = Some((name, "jsonschema", schema.as_bytes()));
        self.put(
            &Label {
                topic,
                encoding: "json",
                schema,
                logged: at,
                published: at,
            },
            &bytes,
        )
    }

    fn put(&mut self, label: &Label<'_>, bytes: &[u8]) -> Result<(), RecordError> {
        let track = self.track(label).map_err(|source| self.failed(source))?;
        let header = MessageHeader {
            channel_id: track.id,
            sequence: track.messages,
            log_time: label.logged.unix_ns_u64(),
            publish_time: label.published.unix_ns_u64(),
        };
        let written = self.writer.write_to_known_channel(&header, bytes);
        written.map_err(|source| self.failed(source))?;
        let (began, size) = self.chunk.unwrap_or((label.logged, 0));
        let size = size + bytes.len() as u64;
        self.chunk = Some((began, size));
        if size >= CHUNK_BYTES || label.logged - began >= CHUNK_SPAN {
            self.flush()?;
        }
        Ok(())
    }

    /// The channel of a label, added when it is new; counts the message.
    fn track(&mut self, label: &Label<'_>) -> mcap::McapResult<Track> {
        let (name, schema_encoding, data) = label.schema.unwrap_or(("", "", &[]));
        let key = (label.topic, name.to_owned());
        if let Some(track) = self.channels.get_mut(&key) {
            track.messages = track.messages.wrapping_add(1);
            return Ok(*track);
        }
        let schema = match label.schema {
            Some(_) => self.writer.add_schema(name, schema_encoding, data)?,
            None => 0,
        };
        let nothing = BTreeMap::new();
        let id = self
            .writer
            .add_channel(schema, label.topic, label.encoding, &nothing)?;
        let track = Track { id, messages: 0 };
        self.channels.insert(key, track);
        Ok(track)
    }

    fn failed(&self, source: mcap::McapError) -> RecordError {
        RecordError::Write {
            path: self.path.clone(),
            source,
        }
    }

    fn unencodable(&self, topic: &'static str, error: &dyn std::error::Error) -> RecordError {
        RecordError::Encode {
            path: self.path.clone(),
            topic,
            message: error.to_string(),
        }
    }
}
