//! What the tests of ingest and record share.

use super::{EncodedImage, ImageEncoding, StereoPair};
use bytes::Bytes;
use emberfix_calib::Rig;
use emberfix_frames::{ServiceTime, SignedDuration, Stamped};
use opencv::core::{CV_8UC3, Mat, Scalar, Vector};
use opencv::prelude::{MatTraitManual, VectorToVec};
use std::path::{Path, PathBuf};

/// 2026-03-01T12:00:00Z.
pub const START_NS: i64 = 1_772_366_400_000_000_000;
pub const MS: i64 = 1_000_000;

pub fn rig() -> Rig {
    Rig::load(&workspace().join("calib/rigs/oakd-75mm.toml")).unwrap()
}

pub fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).to_owned()
}

pub fn at(ms: i64) -> ServiceTime {
    ServiceTime::from_unix_ns(START_NS + ms * MS)
}

/// A picture with structure, different for each seed.
pub fn picture(width: i32, height: i32, seed: u64) -> Mat {
    let grey = Scalar::all(0.0);
    let mut mat = Mat::new_rows_cols_with_default(height, width, CV_8UC3, grey).unwrap();
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    for (index, byte) in mat.data_bytes_mut().unwrap().iter_mut().enumerate() {
        if index % 24 == 0 {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
        }
        *byte = (state >> 56) as u8;
    }
    mat
}

/// An encoded picture; `extension` is `.jpg` or `.png`.
pub fn encode(extension: &str, mat: &Mat, parameters: &[i32]) -> Vec<u8> {
    let mut bytes = Vector::<u8>::new();
    let parameters = Vector::from_slice(parameters);
    assert!(opencv::imgcodecs::imencode(extension, mat, &mut bytes, &parameters).unwrap());
    bytes.to_vec()
}

pub fn jpeg(seed: u64, at: ServiceTime) -> EncodedImage {
    let bytes = Bytes::from(encode(".jpg", &picture(64, 48, seed), &[]));
    EncodedImage {
        encoding: ImageEncoding::Jpeg,
        bytes,
        at,
    }
}

/// Pair number `n` of a 10 Hz camera, exposed at `n` tenths of a second, arrived 20 ms later.
pub fn pair(n: i64) -> Stamped<StereoPair> {
    let exposed = at(100 * n);
    let right = jpeg(2 * n as u64 + 1, exposed + SignedDuration::from_micros(300));
    let value = StereoPair {
        spectra: Vec::new(),
        sequence: n as u64,
        arrived: at(100 * n + 20),
        left: jpeg(2 * n as u64, exposed),
        right: Some(right),
        skew: SignedDuration::from_micros(300),
    };
    Stamped { at: exposed, value }
}
