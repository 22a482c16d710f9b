//! A live camera before which somebody holds a board: pairs of PNG files through a socket as MCAP.

use bytes::Bytes;
use foxglove::Encode;
use foxglove::messages::{CompressedImage, Timestamp};
use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{McapResult, WriteOptions, Writer};
use std::collections::BTreeMap;
use std::net::TcpStream;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Each pair is shown this often, as a board that is held still would be; longer from round to round, for
/// a machine that is too busy to look twice.
const TIMES: [usize; 4] = [4, 8, 16, 32];
/// From one picture to the next.
const PERIOD: Duration = Duration::from_millis(120);

/// Shows the pairs one after the other to whoever listens on `port` of this computer, from a thread of
/// its own, until nobody listens any more.
pub fn show(port: u16, pairs: Vec<[Bytes; 2]>) {
    std::thread::spawn(move || {
        let socket = TcpStream::connect(("127.0.0.1", port)).unwrap();
        // Whoever looked has seen enough and is gone.
        let _gone = send(socket, &pairs);
    });
}

fn send(socket: TcpStream, pairs: &[[Bytes; 2]]) -> McapResult<()> {
    let options = WriteOptions::new()
        .compression(None)
        .chunk_size(None)
        .disable_seeking(true);
    let mut writer = options.create(NoSeek::new(socket))?;
    let schema = CompressedImage::get_schema().unwrap();
    let schema = writer.add_schema(&schema.name, &schema.encoding, &schema.data)?;
    let mut channel = |topic: &str| writer.add_channel(schema, topic, "protobuf", &BTreeMap::new());
    let channels = [
        channel("/stereo/left/image")?,
        channel("/stereo/right/image")?,
    ];
    let rounds = TIMES.iter().flat_map(|&times| {
        pairs
            .iter()
            .flat_map(move |pair| std::iter::repeat_n(pair, times))
    });
    for pair in rounds {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
        for (channel, png) in channels.into_iter().zip(pair) {
            write(&mut writer, channel, png, now)?;
        }
        writer.flush()?;
        std::thread::sleep(PERIOD);
    }
    writer.finish().map(drop)
}

fn write(
    writer: &mut Writer<NoSeek<TcpStream>>,
    channel_id: u16,
    png: &Bytes,
    at: Duration,
) -> McapResult<()> {
    let image = CompressedImage {
        timestamp: Some(Timestamp::new(at.as_secs() as u32, at.subsec_nanos())),
        frame_id: "camera".to_owned(),
        data: png.clone(),
        format: "png".to_owned(),
    };
    let mut bytes = Vec::new();
    image.encode(&mut bytes).unwrap();
    let header = MessageHeader {
        channel_id,
        sequence: 0,
        log_time: at.as_nanos() as u64,
        publish_time: at.as_nanos() as u64,
    };
    writer.write_to_known_channel(&header, &bytes)
}
