//! One GeoTIFF to posts with their places.
//!
//! Read are: geographic WGS84 (EPSG:4326, 4979), one band, 8 to 32 bit integers or 32 and 64 bit
//! floats, strips or tiles, plain, LZW or Deflate with either predictor; `ModelPixelScale` with
//! `ModelTiepoint`, or a `ModelTransformation` that does not turn; pixel-is-area and pixel-is-point;
//! `GDAL_NODATA`. Only the window that is asked for is decoded and kept.
//!
//! **Known limits.** The `tiff` crate can't read some LZW tiles that reach over the image's edge
//! (seen with tiles of 128 pixels and less); they are refused, never read wrongly.

use crate::locate::{Area, VerticalDatum};
use std::fs::File;
use std::io::BufReader;
use std::path::Path;
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::Tag;

/// Why a file was refused.
#[derive(Debug, thiserror::Error)]
pub enum GeoTiffError {
    /// It can't be read.
    #[error("{0}")]
    Read(#[from] std::io::Error),
    /// It is not a TIFF, or a damaged one, or of a kind that is not read.
    #[error("{0}; if GDAL reads it, write it anew: gdal_translate -co COMPRESS=DEFLATE")]
    Tiff(#[from] tiff::TiffError),
    /// A tag that places it on the Earth is missing.
    #[error("has no {tag}: a picture without a place")]
    NoPlace {
        /// Which.
        tag: &'static str,
    },
    /// A tag of the wrong length.
    #[error("{tag} holds {found} numbers, {least} are needed")]
    ShortTag {
        /// Which.
        tag: &'static str,
        /// Numbers in it.
        found: usize,
        /// Numbers that are needed.
        least: usize,
    },
    /// Not latitude and longitude on WGS84.
    #[error(
        "{key} is {found}, read are geographic WGS84 tiles only ({expected}); convert with: gdalwarp -t_srs EPSG:4326"
    )]
    NotGeographic {
        /// GeoTIFF key.
        key: &'static str,
        /// What it says.
        found: u32,
        /// What it should say.
        expected: &'static str,
    },
    /// Turned or sheared against north.
    #[error("its rows do not run west to east; convert with: gdalwarp -t_srs EPSG:4326")]
    Turned,
    /// More than one band.
    #[error("holds {samples} bands, a terrain tile has 1")]
    Bands {
        /// Samples per pixel.
        samples: u16,
    },
    /// A vertical datum or unit that we don't convert.
    #[error("{key} is {found}, known are {known}")]
    Vertical {
        /// GeoTIFF key.
        key: &'static str,
        /// What it says.
        found: u32,
        /// What would have been accepted.
        known: &'static str,
    },
    /// `GDAL_NODATA` that is no number.
    #[error("GDAL_NODATA is {text:?}, which is no number")]
    Nodata {
        /// What stands there.
        text: String,
    },
    /// Bigger than any tile.
    #[error("is {columns} x {rows} pixels, allowed are {most} a side")]
    Size {
        /// Pixels from west to east.
        columns: u32,
        /// Pixels from north to south.
        rows: u32,
        /// Most allowed.
        most: u32,
    },
    /// A sample format that heights do not come in.
    #[error("its samples are {format}, heights are integers or floats of at most 64 bits")]
    Samples {
        /// What they are.
        format: &'static str,
    },
}

/// The part of a file that was asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct Window {
    /// Geodetic latitude of its first row of posts, degrees.
    pub north_deg: f64,
    /// Longitude of its first column of posts, degrees.
    pub west_deg: f64,
    /// From row to row southwards, degrees.
    pub row_pitch_deg: f64,
    /// From column to column eastwards, degrees.
    pub column_pitch_deg: f64,
    /// Rows.
    pub rows: usize,
    /// Columns.
    pub columns: usize,
    /// Row by row from the north-west; voids are not-a-number.
    pub heights_m: Vec<f32>,
    /// What the file says that its heights count from.
    pub datum: Option<VerticalDatum>,
}

/// Most pixels along a side: 1 arc-second over 10 degrees.
const MOST_PIXELS: u32 = 40_000;
/// Most that one strip or tile may decode to, bytes.
const MOST_CHUNK_BYTES: usize = 256 << 20;
/// What integer tiles mark voids with when they do not say.
const USUAL_VOIDS: [f64; 2] = [-32_768.0, -32_767.0];

/// Reads the part of a file that lies in `near`, with one post around; `None` when none does.
///
/// # Errors
/// [`GeoTiffError`] when the file is none, damaged, or of a kind that is not read.
pub fn read(path: &Path, near: &Area) -> Result<Option<Window>, GeoTiffError> {
    let limits = {
        let mut limits = Limits::default();
        limits.decoding_buffer_size = MOST_CHUNK_BYTES;
        limits.intermediate_buffer_size = MOST_CHUNK_BYTES;
        limits
    };
    let mut file = Decoder::new(BufReader::new(File::open(path)?))?.with_limits(limits);
    let (columns, rows) = file.dimensions()?;
    if columns > MOST_PIXELS || rows > MOST_PIXELS {
        return Err(GeoTiffError::Size {
            columns,
            rows,
            most: MOST_PIXELS,
        });
    }
    let samples = file
        .find_tag_unsigned(Tag::SamplesPerPixel)?
        .unwrap_or(1_u16);
    if samples != 1 {
        return Err(GeoTiffError::Bands { samples });
    }
    let keys = GeoKeys::read(&mut file)?;
    keys.check_horizontal()?;
    let grid = Grid::read(&mut file, keys.pixel_is_point())?;
    let datum = keys.datum()?;
    let nodata = nodata(&mut file)?;
    let Some(span) = grid.span(near, columns as usize, rows as usize) else {
        return Ok(None);
    };
    let mut heights_m = vec![f32::NAN; span.rows * span.columns];
    fill(&mut file, &span, nodata, &mut heights_m)?;
    Ok(Some(Window {
        north_deg: grid.north_deg - span.top as f64 * grid.row_pitch_deg,
        west_deg: grid.west_deg + span.left as f64 * grid.column_pitch_deg,
        row_pitch_deg: grid.row_pitch_deg,
        column_pitch_deg: grid.column_pitch_deg,
        rows: span.rows,
        columns: span.columns,
        heights_m,
        datum,
    }))
}

type Tiff = Decoder<BufReader<File>>;

/// The short keys of the GeoKeyDirectory that lie in the directory itself.
struct GeoKeys(Vec<(u32, u32)>);

impl GeoKeys {
    const MODEL_TYPE: u32 = 1024;
    const RASTER_TYPE: u32 = 1025;
    const GEOGRAPHIC_TYPE: u32 = 2048;
    const ANGULAR_UNITS: u32 = 2054;
    const VERTICAL_TYPE: u32 = 4096;
    const VERTICAL_UNITS: u32 = 4099;

    fn read(file: &mut Tiff) -> Result<Self, GeoTiffError> {
        let directory: Vec<u32> =
            file.find_tag_unsigned_vec(Tag::GeoKeyDirectoryTag)?
                .ok_or(GeoTiffError::NoPlace {
                    tag: "GeoKeyDirectory",
                })?;
        // Four numbers of header, then four a key: id, where its value lies (0: here), count, value.
        let entries = directory.chunks_exact(4).skip(1);
        Ok(Self(
            entries
                .filter(|entry| entry[1] == 0)
                .map(|entry| (entry[0], entry[3]))
                .collect(),
        ))
    }

    fn get(&self, key: u32) -> Option<u32> {
        self.0
            .iter()
            .find(|(id, _)| *id == key)
            .map(|(_, value)| *value)
    }

    fn check_horizontal(&self) -> Result<(), GeoTiffError> {
        let checks = [
            ("GTModelType", Self::MODEL_TYPE, vec![2], "2, geographic"),
            (
                "GeographicType",
                Self::GEOGRAPHIC_TYPE,
                vec![4326, 4979],
                "EPSG 4326",
            ),
            (
                "GeogAngularUnits",
                Self::ANGULAR_UNITS,
                vec![9102],
                "9102, degrees",
            ),
        ];
        for (key, id, allowed, expected) in checks {
            let found = match self.get(id) {
                Some(found) => found,
                None if id == Self::ANGULAR_UNITS => continue,
                None => return Err(GeoTiffError::NoPlace { tag: key }),
            };
            if !allowed.contains(&found) {
                return Err(GeoTiffError::NotGeographic {
                    key,
                    found,
                    expected,
                });
            }
        }
        Ok(())
    }

    fn pixel_is_point(&self) -> bool {
        self.get(Self::RASTER_TYPE) == Some(2)
    }

    fn datum(&self) -> Result<Option<VerticalDatum>, GeoTiffError> {
        // 0 and 32767 are "undefined" and "defined by the user", which say nothing.
        let said = |key: u32| self.get(key).filter(|value| ![0, 32_767].contains(value));
        if let Some(found) = said(Self::VERTICAL_UNITS).filter(|unit| *unit != 9001) {
            return Err(GeoTiffError::Vertical {
                key: "VerticalUnits",
                found,
                known: "9001 (metre)",
            });
        }
        match said(Self::VERTICAL_TYPE) {
            None if self.get(Self::GEOGRAPHIC_TYPE) == Some(4979) => {
                Ok(Some(VerticalDatum::Ellipsoid))
            }
            None => Ok(None),
            Some(5773) => Ok(Some(VerticalDatum::Egm96)),
            Some(3855) => Ok(Some(VerticalDatum::Egm2008)),
            // 5030 is GeoTIFF 1.0's own number for "height above the WGS84 ellipsoid".
            Some(4979 | 5030) => Ok(Some(VerticalDatum::Ellipsoid)),
            Some(found) => Err(GeoTiffError::Vertical {
                key: "Vertical",
                found,
                known: "5773 (EGM96), 3855 (EGM2008), 4979 (ellipsoid)",
            }),
        }
    }
}

/// Where post (0, 0) is, and how far to the next ones.
struct Grid {
    north_deg: f64,
    west_deg: f64,
    row_pitch_deg: f64,
    column_pitch_deg: f64,
}

impl Grid {
    fn read(file: &mut Tiff, pixel_is_point: bool) -> Result<Self, GeoTiffError> {
        // A pixel that is an area has its height in its middle.
        let inset = if pixel_is_point { 0.0 } else { 0.5 };
        if let Some(scale) = numbers(file, Tag::ModelPixelScaleTag, "ModelPixelScale", 2)? {
            let tie = numbers(file, Tag::ModelTiepointTag, "ModelTiepoint", 6)?.ok_or(
                GeoTiffError::NoPlace {
                    tag: "ModelTiepoint",
                },
            )?;
            return Ok(Self {
                north_deg: tie[4] - (inset - tie[1]) * scale[1],
                west_deg: tie[3] + (inset - tie[0]) * scale[0],
                row_pitch_deg: scale[1],
                column_pitch_deg: scale[0],
            });
        }
        let matrix = numbers(file, Tag::ModelTransformationTag, "ModelTransformation", 16)?.ok_or(
            GeoTiffError::NoPlace {
                tag: "ModelPixelScale",
            },
        )?;
        if matrix[1] != 0.0 || matrix[4] != 0.0 || matrix[0] <= 0.0 || matrix[5] >= 0.0 {
            return Err(GeoTiffError::Turned);
        }
        Ok(Self {
            north_deg: matrix[7] + inset * matrix[5],
            west_deg: matrix[3] + inset * matrix[0],
            row_pitch_deg: -matrix[5],
            column_pitch_deg: matrix[0],
        })
    }

    /// Rows and columns that an area needs; `None` when it needs none. Pitches that no tile has are
    /// left to the tile's own check.
    fn span(&self, near: &Area, columns: usize, rows: usize) -> Option<Span> {
        let sound = self.row_pitch_deg > 1e-9 && self.column_pitch_deg > 1e-9;
        if !sound {
            return Some(Span {
                top: 0,
                left: 0,
                rows: rows.min(2),
                columns: columns.min(2),
            });
        }
        let (top, bottom) = clipped(
            (self.north_deg - near.north_deg) / self.row_pitch_deg,
            (self.north_deg - near.south_deg) / self.row_pitch_deg,
            rows,
        )?;
        // Longitudes are counted from the middle of the file, so that it has no seam in it.
        let middle = 0.5 * (columns - 1) as f64;
        let middle_deg = self.west_deg + middle * self.column_pitch_deg;
        let half_deg = 0.5 * near.width_deg();
        let offset_deg = (near.west_deg + half_deg - middle_deg + 180.0).rem_euclid(360.0) - 180.0;
        let (left, right) = clipped(
            middle + (offset_deg - half_deg) / self.column_pitch_deg,
            middle + (offset_deg + half_deg) / self.column_pitch_deg,
            columns,
        )?;
        Some(Span {
            top,
            left,
            rows: bottom - top + 1,
            columns: right - left + 1,
        })
    }
}

/// First and last whole index with one more around, within `count`; at least two.
fn clipped(from: f64, to: f64, count: usize) -> Option<(usize, usize)> {
    let (first, last) = (from.floor() - 1.0, to.ceil() + 1.0);
    if last < 0.0 || first > (count - 1) as f64 {
        return None;
    }
    let first = (first.max(0.0) as usize).min(count.saturating_sub(2));
    let last = (last as usize).clamp((first + 1).min(count - 1), count - 1);
    Some((first, last))
}

struct Span {
    top: usize,
    left: usize,
    rows: usize,
    columns: usize,
}

fn numbers(
    file: &mut Tiff,
    tag: Tag,
    name: &'static str,
    least: usize,
) -> Result<Option<Vec<f64>>, GeoTiffError> {
    let Some(value) = file.find_tag(tag)? else {
        return Ok(None);
    };
    let numbers = value.into_f64_vec()?;
    if numbers.len() < least {
        return Err(GeoTiffError::ShortTag {
            tag: name,
            found: numbers.len(),
            least,
        });
    }
    Ok(Some(numbers))
}

fn nodata(file: &mut Tiff) -> Result<Option<f64>, GeoTiffError> {
    let Some(value) = file.find_tag(Tag::GdalNodata)? else {
        return Ok(None);
    };
    let text = value.into_string()?;
    let number = text.trim_matches(|c: char| c.is_whitespace() || c == '\0');
    match number.parse() {
        Ok(number) => Ok(Some(number)),
        Err(_) => Err(GeoTiffError::Nodata { text }),
    }
}

fn fill(
    file: &mut Tiff,
    span: &Span,
    nodata: Option<f64>,
    heights_m: &mut [f32],
) -> Result<(), GeoTiffError> {
    let (columns, _) = file.dimensions()?;
    let (wide, high) = file.chunk_dimensions();
    let (wide, high) = (wide as usize, high as usize);
    let across = (columns as usize).div_ceil(wide);
    for row in span.top / high..=(span.top + span.rows - 1) / high {
        for column in span.left / wide..=(span.left + span.columns - 1) / wide {
            let index = (row * across + column) as u32;
            let (width, _) = file.chunk_data_dimensions(index);
            let values = as_heights(file.read_chunk(index)?, nodata)?;
            copy(
                &values,
                (row * high, column * wide, width as usize),
                span,
                heights_m,
            );
        }
    }
    Ok(())
}

/// The part of one chunk (its first row, first column, width) that lies in the span.
fn copy(
    values: &[f32],
    (top, left, width): (usize, usize, usize),
    span: &Span,
    heights_m: &mut [f32],
) {
    for (line, values) in values.chunks_exact(width.max(1)).enumerate() {
        let Some(row) = (top + line).checked_sub(span.top) else {
            continue;
        };
        if row >= span.rows {
            break;
        }
        for (place, value) in values.iter().enumerate() {
            if let Some(column) = (left + place).checked_sub(span.left)
                && column < span.columns
            {
                heights_m[row * span.columns + column] = *value;
            }
        }
    }
}

fn as_heights(values: DecodingResult, nodata: Option<f64>) -> Result<Vec<f32>, GeoTiffError> {
    fn whole<T: Copy + Into<f64>>(values: Vec<T>, nodata: Option<f64>) -> Vec<f32> {
        let is_void = |value: f64| match nodata {
            Some(nodata) => value == nodata,
            None => USUAL_VOIDS.contains(&value),
        };
        let height = |value: T| {
            let value = value.into();
            if is_void(value) || !value.is_finite() {
                f32::NAN
            } else {
                value as f32
            }
        };
        values.into_iter().map(height).collect()
    }
    let refused = |format| Err(GeoTiffError::Samples { format });
    Ok(match values {
        DecodingResult::U8(values) => whole(values, nodata),
        DecodingResult::I8(values) => whole(values, nodata),
        DecodingResult::U16(values) => whole(values, nodata),
        DecodingResult::I16(values) => whole(values, nodata),
        DecodingResult::U32(values) => whole(values, nodata),
        DecodingResult::I32(values) => whole(values, nodata),
        // A float tile writes its void as a decimal: compare in its own precision.
        DecodingResult::F32(values) => whole(values, nodata.map(|n| f64::from(n as f32))),
        DecodingResult::F64(values) => whole(values, nodata),
        DecodingResult::U64(_) => return refused("64 bit unsigned"),
        DecodingResult::I64(_) => return refused("64 bit signed"),
        DecodingResult::F16(_) => return refused("16 bit floats"),
    })
}
