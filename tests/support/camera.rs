//! A live camera: any program that writes MCAP into a socket.

use crate::pictures;
use emberfix_frames::{ServiceTime, SignedDuration};
use foxglove::Encode;
use foxglove::messages::{CompressedImage, Timestamp};
use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{McapResult, WriteOptions, Writer};
use std::collections::BTreeMap;
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// A pair this often.
const PERIOD: Duration = Duration::from_millis(200);
/// From mid-exposure to the socket.
const LAG: SignedDuration = SignedDuration::from_millis(10);

/// A camera that films until it is dropped or stopped.
pub struct Camera {
    stopping: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Camera {
    /// Connects to a service that listens on `port` of this computer, and films.
    pub fn film(port: u16) -> Self {
        let stopping = Arc::new(AtomicBool::new(false));
        let theirs = Arc::clone(&stopping);
        let thread = std::thread::spawn(move || film(port, &theirs));
        Self {
            stopping,
            thread: Some(thread),
        }
    }

    /// Ends the stream.
    pub fn stop(mut self) {
        self.stopping.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

impl Drop for Camera {
    fn drop(&mut self) {
        self.stopping.store(true, Ordering::Relaxed);
    }
}

fn film(port: u16, stopping: &AtomicBool) {
    let socket = TcpStream::connect(("127.0.0.1", port)).unwrap();
    socket.set_nodelay(true).unwrap();
    let options = WriteOptions::new()
        .compression(None)
        .chunk_size(None)
        .disable_seeking(true);
    let mut writer = options.create(NoSeek::new(socket)).unwrap();
    let schema = CompressedImage::get_schema().unwrap();
    let schema = writer
        .add_schema(&schema.name, &schema.encoding, &schema.data)
        .unwrap();
    let mut channel = |topic: &str| {
        writer
            .add_channel(schema, topic, "protobuf", &BTreeMap::new())
            .unwrap()
    };
    let channels = [
        channel("/stereo/left/image"),
        channel("/stereo/right/image"),
    ];
    for sequence in 0.. {
        if stopping.load(Ordering::Relaxed) {
            break;
        }
        let pair = pictures::pair(sequence, now() - LAG).value;
        let mut images = channels.into_iter().zip([pair.left, pair.right.unwrap()]);
        let written =
            images.try_for_each(|(id, image)| write(&mut writer, id, &image.bytes, image.at));
        // The service may have gone; then nobody looks.
        if written.and_then(|()| writer.flush()).is_err() {
            return;
        }
        std::thread::sleep(PERIOD);
    }
    // Whoever looked may have gone by now.
    let _ended = writer.finish();
}

fn write(
    writer: &mut Writer<NoSeek<TcpStream>>,
    channel_id: u16,
    jpeg: &bytes::Bytes,
    at: ServiceTime,
) -> McapResult<()> {
    let ns = at.unix_ns_u64();
    let timestamp = Timestamp::new((ns / 1_000_000_000) as u32, (ns % 1_000_000_000) as u32);
    let image = CompressedImage {
        timestamp: Some(timestamp),
        frame_id: "camera".to_owned(),
        data: jpeg.clone(),
        format: "jpeg".to_owned(),
    };
    let mut bytes = Vec::new();
    image.encode(&mut bytes).unwrap();
    let header = MessageHeader {
        channel_id,
        sequence: 0,
        log_time: ns,
        publish_time: ns,
    };
    writer.write_to_known_channel(&header, &bytes)
}

fn now() -> ServiceTime {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
    ServiceTime::from_unix_ns(now.as_nanos() as i64)
}
