//! Encoded images to pixels, or the reason why not. Never a partial image, never a turned one.
//!
//! The size that a header states is checked, against a cap and against the rig, before anything is
//! allocated. [`EyeWatch`] judges what a good file shows: black, saturated, frozen.

use super::jpeg::{JpegFault, JpegHeader};
use super::{EncodedImage, ImageEncoding, note};
use emberfix_calib::{Camera, Eye, Rig};
use opencv::core::{self, Mat, Scalar};
use opencv::prelude::MatTraitConst;
use opencv::{imgcodecs, imgproc};
use std::hash::{DefaultHasher, Hash, Hasher};

/// Largest image side in pixels.
const SIDE_LIMIT_PX: u32 = 8192;

/// Why an image was not decoded.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// No image of the encoding that it claims.
    #[error("{encoding} image: {what} at byte {at_byte}")]
    Corrupt {
        /// JPEG or PNG.
        encoding: &'static str,
        /// Which rule is broken.
        what: &'static str,
        /// Where, about.
        at_byte: usize,
    },
    /// Ends too early.
    #[error("{encoding} image: cut off after {bytes} bytes")]
    Truncated {
        /// JPEG, PNG or raw.
        encoding: &'static str,
        /// Bytes that are there.
        bytes: usize,
    },
    /// A kind of image that we refuse to interpret.
    #[error("{encoding} image: {what} is not supported")]
    Unsupported {
        /// JPEG, PNG or raw.
        encoding: &'static str,
        /// What it is.
        what: String,
    },
    /// A side that no camera of ours has; nothing was allocated for it.
    #[error("image claims {found_px:?} pixels, the limit is {limit_px} per side")]
    TooLarge {
        /// Columns, rows as claimed.
        found_px: (u32, u32),
        /// Largest side.
        limit_px: u32,
    },
    /// Not the size that the rig is calibrated for.
    #[error("image is {found_px:?} pixels, the rig's camera {expected_px:?}")]
    Size {
        /// Columns, rows as claimed.
        found_px: (u32, u32),
        /// Columns, rows of the rig.
        expected_px: (u32, u32),
    },
    /// Raw pixels whose row length or amount does not fit their size.
    #[error(
        "raw image: {width_bytes} bytes a row and {rows} rows in steps of {step} do not fit \
         {bytes} bytes"
    )]
    RawLayout {
        /// Bytes that a row of pixels takes.
        width_bytes: u64,
        /// Rows.
        rows: u32,
        /// Bytes from one row to the next, as stated.
        step: u32,
        /// Bytes that are there.
        bytes: usize,
    },
    /// OpenCV could not decode it.
    #[error("image: {source}")]
    OpenCv {
        /// What OpenCV said.
        #[from]
        source: opencv::Error,
    },
}

/// Decodes both eyes' images for one rig.
#[derive(Debug, Clone)]
pub struct ImageDecoder {
    left_size_px: (u32, u32),
    right_size_px: (u32, u32),
    trailing_garbage: u64,
}

impl ImageDecoder {
    /// For a rig: other sizes are refused.
    #[must_use]
    pub fn new(rig: &Rig) -> Self {
        let size = |eye| -> (u32, u32) {
            let camera: &Camera = rig.camera(eye);
            camera.image_size_px
        };
        Self {
            left_size_px: size(Eye::Left),
            right_size_px: size(Eye::Right),
            trailing_garbage: 0,
        }
    }

    /// The left image: rows x columns, 8-bit BGR, not rectified.
    ///
    /// # Errors
    /// [`DecodeError`]; the next image may be fine.
    pub fn left(&mut self, image: &EncodedImage) -> Result<Mat, DecodeError> {
        self.decode(image, self.left_size_px, Pixels::Bgr)
    }

    /// The right image: rows x columns, 8-bit grey, not rectified.
    ///
    /// # Errors
    /// [`DecodeError`]; the next image may be fine.
    pub fn right(&mut self, image: &EncodedImage) -> Result<Mat, DecodeError> {
        self.decode(image, self.right_size_px, Pixels::Grey)
    }

    /// For images of these sizes: others are refused.
    #[must_use]
    pub fn sized(left_size_px: (u32, u32), right_size_px: (u32, u32)) -> Self {
        Self {
            left_size_px,
            right_size_px,
            trailing_garbage: 0,
        }
    }

    /// JPEGs with bytes after their end; the image was used.
    #[must_use]
    pub fn trailing_garbage(&self) -> u64 {
        self.trailing_garbage
    }

    fn decode(
        &mut self,
        image: &EncodedImage,
        expected_px: (u32, u32),
        pixels: Pixels,
    ) -> Result<Mat, DecodeError> {
        match &image.encoding {
            ImageEncoding::Jpeg => {
                let header = JpegHeader::read(&image.bytes).map_err(|f| jpeg(f, &image.bytes))?;
                check_size((header.width, header.height), expected_px)?;
                let trailing = header
                    .check_data(&image.bytes)
                    .map_err(|f| jpeg(f, &image.bytes))?;
                if trailing > 0 {
                    note(
                        &mut self.trailing_garbage,
                        "bytes after a JPEG's end: ignored",
                    );
                }
                unpack(&image.bytes, expected_px, pixels)
            }
            ImageEncoding::Png => {
                check_size(png_size(&image.bytes)?, expected_px)?;
                check_png_end(&image.bytes)?;
                unpack(&image.bytes, expected_px, pixels)
            }
            ImageEncoding::Raw {
                encoding,
                width,
                height,
                step,
            } => {
                check_size((*width, *height), expected_px)?;
                let rows = RawRows {
                    width: *width,
                    height: *height,
                    step: *step,
                };
                raw(&image.bytes, encoding, rows, pixels)
            }
        }
    }
}

/// Columns and rows that an image's own header states, within what any camera of ours has.
///
/// # Errors
/// [`DecodeError`] where it is no image.
pub fn stated_size_px(image: &EncodedImage) -> Result<(u32, u32), DecodeError> {
    let size = match &image.encoding {
        ImageEncoding::Jpeg => {
            let header = JpegHeader::read(&image.bytes).map_err(|f| jpeg(f, &image.bytes))?;
            (header.width, header.height)
        }
        ImageEncoding::Png => png_size(&image.bytes)?,
        ImageEncoding::Raw { width, height, .. } => (*width, *height),
    };
    check_size(size, size)?;
    Ok(size)
}

#[derive(Debug, Clone, Copy)]
enum Pixels {
    Bgr,
    Grey,
}

fn jpeg(fault: JpegFault, bytes: &[u8]) -> DecodeError {
    let encoding = "JPEG";
    match fault {
        JpegFault::Truncated => DecodeError::Truncated {
            encoding,
            bytes: bytes.len(),
        },
        JpegFault::Corrupt { what, at_byte } => DecodeError::Corrupt {
            encoding,
            what,
            at_byte,
        },
        JpegFault::Unsupported { what } => DecodeError::Unsupported {
            encoding,
            what: what.to_owned(),
        },
    }
}

fn check_size(found_px: (u32, u32), expected_px: (u32, u32)) -> Result<(), DecodeError> {
    if found_px.0.max(found_px.1) > SIDE_LIMIT_PX {
        return Err(DecodeError::TooLarge {
            found_px,
            limit_px: SIDE_LIMIT_PX,
        });
    }
    if found_px != expected_px {
        return Err(DecodeError::Size {
            found_px,
            expected_px,
        });
    }
    Ok(())
}

/// Decodes a JPEG or PNG that was found whole.
fn unpack(bytes: &[u8], expected_px: (u32, u32), pixels: Pixels) -> Result<Mat, DecodeError> {
    let colour = match pixels {
        Pixels::Bgr => imgcodecs::IMREAD_COLOR,
        Pixels::Grey => imgcodecs::IMREAD_GRAYSCALE,
    };
    let flags = colour | imgcodecs::IMREAD_IGNORE_ORIENTATION;
    let mat = imgcodecs::imdecode(&Mat::from_slice(bytes)?, flags)?;
    let found_px = (mat.cols().unsigned_abs(), mat.rows().unsigned_abs());
    // An empty matrix is how OpenCV says that it could not.
    if found_px != expected_px {
        return Err(DecodeError::Size {
            found_px,
            expected_px,
        });
    }
    Ok(mat)
}

const PNG_MAGIC: &[u8] = b"\x89PNG\r\n\x1a\n";

fn png_size(bytes: &[u8]) -> Result<(u32, u32), DecodeError> {
    let encoding = "PNG";
    if !bytes.starts_with(PNG_MAGIC) || bytes.get(12..16) != Some(b"IHDR") {
        return Err(DecodeError::Corrupt {
            encoding,
            what: "no PNG header",
            at_byte: 0,
        });
    }
    let header: &[u8; 10] =
        bytes
            .get(16..)
            .and_then(|rest| rest.first_chunk())
            .ok_or(DecodeError::Truncated {
                encoding,
                bytes: bytes.len(),
            })?;
    let [w3, w2, w1, w0, h3, h2, h1, h0, depth, colour] = *header;
    if depth != 8 {
        return Err(DecodeError::Unsupported {
            encoding,
            what: format!("{depth} bits per sample"),
        });
    }
    if !matches!(colour, 0 | 2) {
        let what = format!("colour type {colour} (neither grey nor RGB)");
        return Err(DecodeError::Unsupported { encoding, what });
    }
    Ok((
        u32::from_be_bytes([w3, w2, w1, w0]),
        u32::from_be_bytes([h3, h2, h1, h0]),
    ))
}

/// Walks the chunks: the last one must be there.
fn check_png_end(bytes: &[u8]) -> Result<(), DecodeError> {
    let truncated = || DecodeError::Truncated {
        encoding: "PNG",
        bytes: bytes.len(),
    };
    let mut at = PNG_MAGIC.len();
    loop {
        let head: &[u8; 8] = bytes
            .get(at..)
            .and_then(|rest| rest.first_chunk())
            .ok_or_else(truncated)?;
        let length = u32::from_be_bytes([head[0], head[1], head[2], head[3]]);
        let end = (at as u64) + 12 + u64::from(length);
        if end > bytes.len() as u64 {
            return Err(truncated());
        }
        if &head[4..] == b"IEND" {
            return Ok(());
        }
        at = usize::try_from(end).unwrap_or(usize::MAX);
    }
}

#[derive(Debug, Clone, Copy)]
struct RawRows {
    width: u32,
    height: u32,
    step: u32,
}

fn raw(bytes: &[u8], encoding: &str, rows: RawRows, pixels: Pixels) -> Result<Mat, DecodeError> {
    let channels = match encoding {
        "bgr8" | "8UC3" | "rgb8" => 3,
        "mono8" | "8UC1" => 1,
        _ => {
            let what = format!("encoding {encoding:?} (bgr8, rgb8 and mono8 are)");
            return Err(DecodeError::Unsupported {
                encoding: "raw",
                what,
            });
        }
    };
    let packed = packed_rows(bytes, rows, channels)?;
    let (height, width) = (rows.height as i32, rows.width as i32);
    let source = Mat::new_rows_cols_with_bytes::<u8>(height, width * channels, &packed)?;
    let source = source.reshape(channels, height)?;
    let code = match (encoding, channels, pixels) {
        ("rgb8", _, Pixels::Bgr) => imgproc::COLOR_RGB2BGR,
        ("rgb8", _, Pixels::Grey) => imgproc::COLOR_RGB2GRAY,
        (_, 3, Pixels::Grey) => imgproc::COLOR_BGR2GRAY,
        (_, 1, Pixels::Bgr) => imgproc::COLOR_GRAY2BGR,
        _ => return Ok(source.clone_pointee()),
    };
    let mut converted = Mat::default();
    imgproc::cvt_color_def(&source, &mut converted, code)?;
    Ok(converted)
}

/// The pixels without what stands between the rows.
fn packed_rows(bytes: &[u8], rows: RawRows, channels: i32) -> Result<Vec<u8>, DecodeError> {
    let width_bytes = u64::from(rows.width) * u64::from(channels.unsigned_abs());
    let before_last = u64::from(rows.height.saturating_sub(1)) * u64::from(rows.step);
    let needed = before_last + width_bytes;
    if u64::from(rows.step) < width_bytes || (bytes.len() as u64) < needed {
        return Err(DecodeError::RawLayout {
            width_bytes,
            rows: rows.height,
            step: rows.step,
            bytes: bytes.len(),
        });
    }
    let width_bytes = usize::try_from(width_bytes).unwrap_or(usize::MAX);
    let lines = bytes.chunks(rows.step as usize).take(rows.height as usize);
    Ok(lines
        .flat_map(|line| line.iter().take(width_bytes))
        .copied()
        .collect())
}

/// What an eye's picture shows about the eye.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum EyeHealth {
    /// Nothing wrong.
    Good,
    /// All dark and without structure: covered, unplugged, or no exposure.
    Black {
        /// Mean of the brightest channel, 0..255.
        mean: f64,
        /// Its standard deviation.
        deviation: f64,
    },
    /// All bright and without structure.
    Saturated {
        /// Mean of the darkest channel, 0..255.
        mean: f64,
        /// Its standard deviation.
        deviation: f64,
    },
    /// The same bytes again and again: a stuck camera. Noise alone makes real frames differ.
    Frozen {
        /// Frames in a row that were the same.
        frames: u32,
    },
}

/// Watches one eye.
#[derive(Debug, Clone, Default)]
pub struct EyeWatch {
    fingerprint: Option<u64>,
    same: u32,
}

/// Mean below which an image without structure is black.
const BLACK_MEAN: f64 = 6.0;
/// Mean above which an image without structure is saturated.
const SATURATED_MEAN: f64 = 249.0;
/// Standard deviation below which an image has no structure.
const FLAT_DEVIATION: f64 = 3.0;
/// Frames in a row with the same bytes that make a camera frozen.
const FROZEN_FRAMES: u32 = 5;

impl EyeWatch {
    /// Judges the next image of this eye.
    ///
    /// # Errors
    /// What OpenCV says, which for a decoded image is nothing.
    pub fn check(&mut self, image: &EncodedImage, pixels: &Mat) -> opencv::Result<EyeHealth> {
        let mut hasher = DefaultHasher::new();
        image.bytes.hash(&mut hasher);
        let fingerprint = Some(hasher.finish());
        self.same = if fingerprint == self.fingerprint {
            self.same.saturating_add(1)
        } else {
            1
        };
        self.fingerprint = fingerprint;
        if self.same >= FROZEN_FRAMES {
            return Ok(EyeHealth::Frozen { frames: self.same });
        }
        brightness(pixels)
    }
}

fn brightness(pixels: &Mat) -> opencv::Result<EyeHealth> {
    let (mut means, mut deviations) = (Scalar::default(), Scalar::default());
    core::mean_std_dev_def(pixels, &mut means, &mut deviations)?;
    let channels = usize::try_from(pixels.channels()).unwrap_or(1).clamp(1, 4);
    let deviation = deviations[..channels].iter().copied().fold(0.0, f64::max);
    let most = means[..channels].iter().copied().fold(0.0, f64::max);
    let least = means[..channels].iter().copied().fold(255.0, f64::min);
    Ok(if deviation > FLAT_DEVIATION {
        EyeHealth::Good
    } else if most < BLACK_MEAN {
        EyeHealth::Black {
            mean: most,
            deviation,
        }
    } else if least > SATURATED_MEAN {
        EyeHealth::Saturated {
            mean: least,
            deviation,
        }
    } else {
        EyeHealth::Good
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ingest::testing::{at, encode, picture};
    use bytes::Bytes;
    use opencv::imgcodecs::{
        IMWRITE_JPEG_PROGRESSIVE, IMWRITE_JPEG_QUALITY, IMWRITE_JPEG_RST_INTERVAL,
    };
    use opencv::prelude::MatTraitConstManual;

    const SIZE: (u32, u32) = (72, 50); // no multiple of a block, nor of 16

    fn decoder() -> ImageDecoder {
        ImageDecoder {
            left_size_px: SIZE,
            right_size_px: SIZE,
            trailing_garbage: 0,
        }
    }

    fn encoded(encoding: ImageEncoding, bytes: Vec<u8>) -> EncodedImage {
        EncodedImage {
            encoding,
            bytes: Bytes::from(bytes),
            at: at(0),
        }
    }

    fn jpeg_bytes(parameters: &[i32]) -> Vec<u8> {
        encode(".jpg", &picture(72, 50, 7), parameters)
    }

    fn left(bytes: &[u8]) -> Result<Mat, DecodeError> {
        decoder().left(&encoded(ImageEncoding::Jpeg, bytes.to_vec()))
    }

    #[test]
    fn whole_jpegs_of_every_common_kind_are_decoded_in_both_eyes() {
        let kinds: [&[i32]; 4] = [
            &[],
            &[IMWRITE_JPEG_QUALITY, 100],
            &[IMWRITE_JPEG_RST_INTERVAL, 3],
            &[IMWRITE_JPEG_PROGRESSIVE, 1],
        ];
        for parameters in kinds {
            let image = encoded(ImageEncoding::Jpeg, jpeg_bytes(parameters));
            let bgr = decoder().left(&image).unwrap();
            assert_eq!((bgr.cols(), bgr.rows(), bgr.channels()), (72, 50, 3));
            let grey = decoder().right(&image).unwrap();
            assert_eq!((grey.cols(), grey.rows(), grey.channels()), (72, 50, 1));
        }
        let mut grey = Mat::default();
        imgproc::cvt_color_def(&picture(72, 50, 7), &mut grey, imgproc::COLOR_BGR2GRAY).unwrap();
        assert_eq!(left(&encode(".jpg", &grey, &[])).unwrap().channels(), 3);
    }

    #[test]
    fn a_jpeg_cut_off_anywhere_is_refused() {
        for parameters in [&[][..], &[IMWRITE_JPEG_PROGRESSIVE, 1]] {
            let whole = jpeg_bytes(parameters);
            for length in 0..whole.len() {
                assert!(
                    left(&whole[..length]).is_err(),
                    "{length} of {} bytes",
                    whole.len()
                );
            }
        }
    }

    #[test]
    fn a_jpeg_cut_off_and_ended_properly_is_still_refused() {
        let whole = jpeg_bytes(&[]);
        for length in (700..whole.len() - 3).step_by(7) {
            let mut cut = whole[..length].to_vec();
            cut.extend_from_slice(&[0xFF, 0xD9]);
            assert!(left(&cut).is_err(), "{length} of {} bytes", whole.len());
        }
    }

    #[test]
    fn damage_that_breaks_the_huffman_code_is_found_and_none_panics() {
        let whole = jpeg_bytes(&[]);
        let begin = whole.windows(2).position(|w| w == [0xFF, 0xDA]).unwrap() + 14;
        let (mut found, mut tried) = (0, 0);
        for byte in begin..whole.len() - 2 {
            let mut damaged = whole.clone();
            damaged[byte] ^= 0x55;
            tried += 1;
            found += usize::from(left(&damaged).is_err());
        }
        // The code synchronises itself again after damage, and value bits may be anything: what is
        // not found is a valid file of another picture, which chunk and link checksums are for.
        assert!(found * 2 > tried, "{found} of {tried}");
        for byte in 0..begin {
            let mut damaged = whole.clone();
            damaged[byte] ^= 0xFF;
            drop(left(&damaged));
        }
    }

    #[test]
    fn garbage_after_the_end_is_counted_and_ignored() {
        let mut bytes = jpeg_bytes(&[]);
        bytes.extend_from_slice(b"garbage");
        let mut decoder = decoder();
        decoder.left(&encoded(ImageEncoding::Jpeg, bytes)).unwrap();
        assert_eq!(decoder.trailing_garbage(), 1);
    }

    fn with_frame_header(change: impl FnOnce(&mut [u8])) -> Vec<u8> {
        let mut bytes = jpeg_bytes(&[]);
        let frame = bytes.windows(2).position(|w| w == [0xFF, 0xC0]).unwrap();
        change(&mut bytes[frame + 4..]);
        bytes
    }

    #[test]
    fn a_header_bomb_is_refused_by_its_header_alone() {
        let bomb =
            with_frame_header(|frame| frame[1..5].copy_from_slice(&[0xFF, 0xDC, 0xFF, 0xDC]));
        let error = left(&bomb).unwrap_err();
        assert!(
            matches!(
                error,
                DecodeError::TooLarge {
                    found_px: (65_500, 65_500),
                    ..
                }
            ),
            "{error}"
        );
        let other = with_frame_header(|frame| frame[2] = 51);
        assert!(matches!(
            left(&other),
            Err(DecodeError::Size {
                found_px: (72, 51),
                ..
            })
        ));
    }

    #[test]
    fn twelve_bits_four_colours_and_turned_pictures_are_refused_by_name() {
        let refuse = |bytes: &[u8]| left(bytes).unwrap_err().to_string();
        assert!(refuse(&with_frame_header(|frame| frame[0] = 12)).contains("8 bits"));
        assert!(refuse(&with_frame_header(|frame| frame[5] = 4)).contains("CMYK"));
        let mut turned = jpeg_bytes(&[]);
        let exif: &[u8] = b"\xFF\xE1\x00\x22Exif\0\0MM\0\x2A\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0";
        turned.splice(2..2, exif.iter().copied());
        assert!(refuse(&turned).contains("EXIF"));
    }

    #[test]
    fn a_png_is_read_exactly_and_refused_when_cut_off_or_deep() {
        let pixels = picture(72, 50, 3);
        let png = encode(".png", &pixels, &[]);
        let decoded = decoder()
            .left(&encoded(ImageEncoding::Png, png.clone()))
            .unwrap();
        assert_eq!(decoded.data_bytes().unwrap(), pixels.data_bytes().unwrap());
        for length in (0..png.len()).step_by(11) {
            let cut = encoded(ImageEncoding::Png, png[..length].to_vec());
            assert!(decoder().left(&cut).is_err(), "{length}");
        }
        let mut deep = png;
        deep[24] = 16;
        let error = decoder()
            .left(&encoded(ImageEncoding::Png, deep))
            .unwrap_err();
        assert!(error.to_string().contains("16 bits"), "{error}");
    }

    fn raw_image(encoding: &str, step: u32, bytes: Vec<u8>) -> EncodedImage {
        let (width, height) = SIZE;
        encoded(
            ImageEncoding::Raw {
                encoding: encoding.to_owned(),
                width,
                height,
                step,
            },
            bytes,
        )
    }

    #[test]
    fn raw_rows_are_unpadded_and_colours_ordered() {
        let pixels = picture(72, 50, 3);
        let plain = pixels.data_bytes().unwrap();
        let padded: Vec<u8> = plain
            .chunks(72 * 3)
            .flat_map(|row| row.iter().copied().chain([9; 8]))
            .collect();
        let bgr = decoder()
            .left(&raw_image("bgr8", 72 * 3 + 8, padded.clone()))
            .unwrap();
        assert_eq!(bgr.data_bytes().unwrap(), plain);
        let rgb = decoder()
            .left(&raw_image("rgb8", 72 * 3 + 8, padded))
            .unwrap();
        assert_eq!(
            rgb.data_bytes().unwrap()[..3],
            [plain[2], plain[1], plain[0]]
        );
        let mono = decoder()
            .left(&raw_image("mono8", 72, vec![5; 72 * 50]))
            .unwrap();
        assert_eq!(mono.data_bytes().unwrap()[..3], [5, 5, 5]);
    }

    #[test]
    fn raw_images_that_lie_about_their_layout_are_refused() {
        let refuse = |image: &EncodedImage| decoder().left(image).unwrap_err();
        let short = refuse(&raw_image("bgr8", 216, vec![0; 216 * 50 - 1]));
        assert!(matches!(short, DecodeError::RawLayout { .. }), "{short}");
        let narrow = refuse(&raw_image("bgr8", 72, vec![0; 216 * 50]));
        assert!(matches!(narrow, DecodeError::RawLayout { .. }), "{narrow}");
        let wide = refuse(&raw_image("bgr8", u32::MAX, vec![0; 216 * 50]));
        assert!(matches!(wide, DecodeError::RawLayout { .. }), "{wide}");
        assert!(
            refuse(&raw_image("mono16", 144, vec![0; 144 * 50]))
                .to_string()
                .contains("mono16")
        );
    }

    #[test]
    fn dead_and_stuck_eyes_are_told_from_live_ones() {
        let image = |seed: u8| encoded(ImageEncoding::Png, vec![seed]);
        let flat = |value: f64| {
            Mat::new_rows_cols_with_default(50, 72, core::CV_8UC1, Scalar::all(value)).unwrap()
        };
        let mut watch = EyeWatch::default();
        assert_eq!(
            watch.check(&image(0), &picture(72, 50, 1)).unwrap(),
            EyeHealth::Good
        );
        assert!(matches!(
            watch.check(&image(1), &flat(2.0)).unwrap(),
            EyeHealth::Black { .. }
        ));
        assert!(matches!(
            watch.check(&image(2), &flat(255.0)).unwrap(),
            EyeHealth::Saturated { .. }
        ));
        assert_eq!(
            watch.check(&image(3), &flat(128.0)).unwrap(),
            EyeHealth::Good
        );
        for _ in 0..3 {
            assert_eq!(
                watch.check(&image(3), &flat(128.0)).unwrap(),
                EyeHealth::Good
            );
        }
        assert_eq!(
            watch.check(&image(3), &flat(128.0)).unwrap(),
            EyeHealth::Frozen { frames: 5 }
        );
        assert_eq!(
            watch.check(&image(4), &flat(128.0)).unwrap(),
            EyeHealth::Good
        );
    }
}
