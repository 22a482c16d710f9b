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
