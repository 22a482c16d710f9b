//! Pictures for the plain rig: a rough surface that faces the camera at one depth.

use bytes::Bytes;
use emberfix::ingest::{EncodedImage, ImageEncoding, StereoPair};
use emberfix_frames::{ServiceTime, SignedDuration, Stamped};
use image::codecs::jpeg::JpegEncoder;
use image::{GrayImage, Luma};

const WIDTH: u32 = 640;
const HEIGHT: u32 = 360;
/// What the right eye sees lies this many columns further left.
const DISPARITY_PX: u32 = 8;
/// The surface's depth by the plain rig: `f b / d`, metres.
pub const DEPTH_M: f64 = 440.0 * 0.3 / DISPARITY_PX as f64;

/// The surface's roughness at a place: spots of three pixels, others in every picture.
fn spot(column: u32, row: u32, sequence: u64) -> u8 {
    let mut state = u64::from(column / 3) << 40 | u64::from(row / 3) << 20 | sequence;
    state = (state ^ state >> 31).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    state = (state ^ state >> 29).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    40 + (state >> 57) as u8
}

fn jpeg(picture: &GrayImage) -> Bytes {
    let mut bytes = Vec::new();
    picture
        .write_with_encoder(JpegEncoder::new_with_quality(&mut bytes, 92))
        .unwrap();
    bytes.into()
}

/// One eye's picture as a JPEG file; `shift` columns to the left.
fn eye(sequence: u64, shift: u32) -> Bytes {
    let pixel = |column, row| Luma([spot(column + shift, row, sequence)]);
    jpeg(&GrayImage::from_fn(WIDTH, HEIGHT, pixel))
}

/// What a covered lens gives.
pub fn black() -> Bytes {
    jpeg(&GrayImage::new(WIDTH, HEIGHT))
}

/// A pair of the surface, exposed at `at`, arrived 20 ms later.
pub fn pair(sequence: u64, at: ServiceTime) -> Stamped<StereoPair> {
    let image = |bytes| EncodedImage {
        encoding: ImageEncoding::Jpeg,
        bytes,
        at,
    };
    let value = StereoPair {
        spectra: Vec::new(),
        sequence,
        arrived: at + SignedDuration::from_millis(20),
        left: image(eye(sequence, 0)),
        right: Some(image(eye(sequence, DISPARITY_PX))),
        skew: SignedDuration::ZERO,
    };
    Stamped { at, value }
}

/// A box file that sees a fire in the same place of each of the first `pairs` pictures.
pub fn boxes(pairs: u64) -> String {
    let line = |sequence| format!("{sequence},300,190,40,50,fire,0.9\n");
    (0..pairs).map(line).collect()
}
