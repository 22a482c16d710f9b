//! A folder of image pairs with timestamps.
//!
//! Layouts, the first that is there counts:
//! - named by time: `left/` and `right/`, or EuRoC's `mav0/cam0/data/` and `mav0/cam1/data/`; files
//!   `<UTC nanoseconds>.png|jpg`; eyes are matched by time, within the rig's greatest skew;
//! - numbered: `image_l/` and `image_r/` (or `image_0/`, `image_1/`); files `000000.png`; times from
//!   `times.txt` (a line per image: seconds, or nanoseconds as whole number of 16 digits and more),
//!   counted from `start_utc` if that is given, or from `rate_hz` and `start_utc`.
//!
//! Pairs come as fast as they are asked for; each arrives at its exposure.

use super::{EncodedImage, ImageEncoding, SourceCounters, SourceError, StereoPair, StereoSource};
use bytes::Bytes;
use emberfix_frames::{ServiceTime, SignedDuration, Stamped, seconds};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Where a folder is, and what its files do not say.
#[derive(Debug, Clone, PartialEq)]
pub struct FolderAddress {
    /// The folder.
    pub path: PathBuf,
    /// Pairs per second, when there is no `times.txt`.
    pub rate_hz: Option<f64>,
    /// Time of the first pair (with `rate_hz`), or what `times.txt` counts from.
    pub start_utc: Option<ServiceTime>,
}

const LAYOUTS: &str = "left/ and right/ with <UTC ns>.png|jpg, mav0/cam0/data/ and mav0/cam1/data/, \
                       or image_l/ and image_r/ with 000000.png and times.txt or ?rate_hz=";
const TIMED_NAME: &str = "<UTC nanoseconds>.png, .jpg or .jpeg";
const NUMBERED_NAME: &str = "<number>.png, .jpg or .jpeg";
const TIMES_LINE: &str = "seconds, or nanoseconds of 16 digits and more";

const TIMED: [(&str, &str); 2] = [("left", "right"), ("mav0/cam0/data", "mav0/cam1/data")];
const NUMBERED: [(&str, &str); 2] = [("image_l", "image_r"), ("image_0", "image_1")];

/// Files of one pair.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Planned {
    at: ServiceTime,
    left: PathBuf,
    right: Option<(ServiceTime, PathBuf)>,
}

/// An opened folder.
#[derive(Debug)]
pub struct Folder {
    plan: std::vec::IntoIter<Planned>,
    counters: SourceCounters,
}

impl Folder {
    /// Lists the folder and pairs its files; reads no image yet.
    ///
    /// # Errors
    /// [`SourceError`] naming the folder, file or line that does not fit, and what would.
    pub fn open(address: &FolderAddress, max_skew_s: f64) -> Result<Self, SourceError> {
        let find = |layouts: [(&str, &str); 2]| {
            let folders = layouts.map(|(l, r)| (address.path.join(l), address.path.join(r)));
            folders.into_iter().find(|(left, _)| left.is_dir())
        };
        let mut counters = SourceCounters {
            openings: 1,
            ..SourceCounters::default()
        };
        let plan = if let Some((left, right)) = find(TIMED) {
            let (left, right) = (list(&left, TIMED_NAME)?, list_if_there(&right, TIMED_NAME)?);
            pair_by_time(left, right, seconds(max_skew_s), &mut counters)
        } else if let Some((left, right)) = find(NUMBERED) {
            let (left, right) = (
                list(&left, NUMBERED_NAME)?,
                list_if_there(&right, NUMBERED_NAME)?,
            );
            let times = Timing::of(address)?;
            pair_by_number(left, right, &times, address, &mut counters)?
        } else {
            return Err(layout(
                address,
                "none of the known subfolders is there".to_owned(),
            ));
        };
        if plan.is_empty() {
            return Err(layout(address, "no left images".to_owned()));
        }
        Ok(Self {
            plan: plan.into_iter(),
            counters,
        })
    }
}

impl StereoSource for Folder {
    fn next_pair(&mut self) -> Result<Option<Stamped<StereoPair>>, SourceError> {
        let Some(planned) = self.plan.next() else {
            return Ok(None);
        };
        let left = read(&planned.left, planned.at)?;
        let right = match &planned.right {
            Some((at, path)) => Some(read(path, *at)?),
            None => None,
        };
        let right_at = right.as_ref().map_or(planned.at, |right| right.at);
        let pair = StereoPair {
            spectra: Vec::new(),
            sequence: self.counters.delivered,
            arrived: planned.at.max(right_at),
            skew: right_at - planned.at,
            left,
            right,
        };
        self.counters.delivered += 1;
        Ok(Some(Stamped {
            at: planned.at,
            value: pair,
        }))
    }

    fn counters(&self) -> SourceCounters {
        self.counters
    }
}

fn layout(address: &FolderAddress, found: String) -> SourceError {
    SourceError::Layout {
        path: address.path.clone(),
        found,
        expected: LAYOUTS,
    }
}

fn io_error(path: &Path) -> impl Fn(std::io::Error) -> SourceError {
    let source_name = path.display().to_string();
    move |source| SourceError::Io {
        source_name: source_name.clone(),
        source,
    }
}

fn read(path: &Path, at: ServiceTime) -> Result<EncodedImage, SourceError> {
    let bytes = Bytes::from(std::fs::read(path).map_err(io_error(path))?);
    let encoding = match extension(path).as_deref() {
        Some("png") => ImageEncoding::Png,
        _ => ImageEncoding::Jpeg,
    };
    Ok(EncodedImage {
        encoding,
        bytes,
        at,
    })
}

fn extension(path: &Path) -> Option<String> {
    Some(path.extension()?.to_str()?.to_ascii_lowercase())
}

/// A folder's images by the number in their name; other files (`data.csv`) are left alone.
fn list(folder: &Path, expected: &'static str) -> Result<BTreeMap<i64, PathBuf>, SourceError> {
    let mut images = BTreeMap::new();
    for entry in std::fs::read_dir(folder).map_err(io_error(folder))? {
        let path = entry.map_err(io_error(folder))?.path();
        if !matches!(extension(&path).as_deref(), Some("png" | "jpg" | "jpeg")) {
            continue;
        }
        let number = path
            .file_stem()
            .and_then(|stem| stem.to_str())
            .and_then(whole_number);
        let number = number.ok_or_else(|| SourceError::FileName {
            path: path.clone(),
            expected,
        })?;
        if images.insert(number, path.clone()).is_some() {
            return Err(SourceError::FileName {
                path,
                expected: "there once per time or number",
            });
        }
    }
    Ok(images)
}

fn list_if_there(
    folder: &Path,
    expected: &'static str,
) -> Result<BTreeMap<i64, PathBuf>, SourceError> {
    if folder.is_dir() {
        list(folder, expected)
    } else {
        Ok(BTreeMap::new())
    }
}

/// Digits only: no sign, no blank.
fn whole_number(text: &str) -> Option<i64> {
    text.bytes()
        .all(|byte| byte.is_ascii_digit())
        .then(|| text.parse().ok())?
}

fn pair_by_time(
    left: BTreeMap<i64, PathBuf>,
    mut right: BTreeMap<i64, PathBuf>,
    max_skew: SignedDuration,
    counters: &mut SourceCounters,
) -> Vec<Planned> {
    let mut plan = Vec::with_capacity(left.len());
    for (ns, path) in left {
        let at = ServiceTime::from_unix_ns(ns);
        let reach = (at - max_skew).unix_ns()..=(at + max_skew).unix_ns();
        let nearest = right
            .range(reach)
            .map(|(ns, _)| *ns)
            .min_by_key(|r| r.abs_diff(ns));
        let partner = nearest.and_then(|r| Some((ServiceTime::from_unix_ns(r), right.remove(&r)?)));
        count_eyes(partner.is_some(), counters);
        plan.push(Planned {
            at,
            left: path,
            right: partner,
        });
    }
    counters.stream.right_alone = right.len() as u64;
    plan
}

fn pair_by_number(
    left: BTreeMap<i64, PathBuf>,
    mut right: BTreeMap<i64, PathBuf>,
    times: &Timing,
    address: &FolderAddress,
    counters: &mut SourceCounters,
) -> Result<Vec<Planned>, SourceError> {
    if let Timing::Listed(times) = times
        && times.len() != left.len()
    {
        let found = format!(
            "times.txt has {} times for {} left images",
            times.len(),
            left.len()
        );
        return Err(layout(address, found));
    }
    let mut plan = Vec::with_capacity(left.len());
    for ((number, path), index) in left.into_iter().zip(0..) {
        let Some(at) = times.at(index) else { break };
        let partner = right.remove(&number).map(|path| (at, path));
        count_eyes(partner.is_some(), counters);
        plan.push(Planned {
            at,
            left: path,
            right: partner,
        });
    }
    counters.stream.right_alone = right.len() as u64;
    match plan.windows(2).find(|two| two[1].at <= two[0].at) {
        Some(two) => Err(layout(
            address,
            format!("times do not rise at {}", two[1].at),
        )),
        None => Ok(plan),
    }
}

fn count_eyes(both: bool, counters: &mut SourceCounters) {
    if both {
        counters.stream.pairs += 1;
    } else {
        counters.stream.left_alone += 1;
    }
}

/// When numbered images were taken.
enum Timing {
    Listed(Vec<ServiceTime>),
    Steady { start: ServiceTime, rate_hz: f64 },
}

impl Timing {
    fn of(address: &FolderAddress) -> Result<Self, SourceError> {
        let start = address.start_utc;
        if let Some(rate_hz) = address.rate_hz {
            let start = start.unwrap_or(ServiceTime::from_unix_ns(0));
            return Ok(Self::Steady { start, rate_hz });
        }
        let path = address.path.join("times.txt");
        if !path.is_file() {
            return Err(layout(
                address,
                "neither times.txt nor ?rate_hz= says when".to_owned(),
            ));
        }
        let text = std::fs::read_to_string(&path).map_err(io_error(&path))?;
        let mut times = Vec::new();
        for (line, number) in text
            .lines()
            .map(str::trim)
            .zip(1..)
            .filter(|(l, _)| !l.is_empty())
        {
            let ns = nanoseconds(line).ok_or_else(|| SourceError::Times {
                path: path.clone(),
                line: number,
                text: line.to_owned(),
                expected: TIMES_LINE,
            })?;
            let since = start.map_or(0, ServiceTime::unix_ns);
            times.push(ServiceTime::from_unix_ns(since.saturating_add(ns)));
        }
        Ok(Self::Listed(times))
    }

    fn at(&self, index: u32) -> Option<ServiceTime> {
        match self {
            Self::Listed(times) => times.get(index as usize).copied(),
            Self::Steady { start, rate_hz } => Some(*start + seconds(f64::from(index) / rate_hz)),
        }
    }
}

/// A time in nanoseconds: exactly from plain decimals, and from what numpy prints (`1.2e+01`).
fn nanoseconds(text: &str) -> Option<i64> {
    match whole_number(text) {
        Some(ns) if text.len() >= 16 => Some(ns),
        Some(seconds) => seconds.checked_mul(1_000_000_000),
        None => decimal_seconds(text).or_else(|| float_seconds(text)),
    }
}

fn decimal_seconds(text: &str) -> Option<i64> {
    let (whole, fraction) = text.split_once('.')?;
    if whole.is_empty() || !(1..=9).contains(&fraction.len()) {
        return None;
    }
    let scale = 10_i64.pow(9 - u32::try_from(fraction.len()).ok()?);
    let part = whole_number(fraction)? * scale;
    whole_number(whole)?
        .checked_mul(1_000_000_000)?
        .checked_add(part)
}

fn float_seconds(text: &str) -> Option<i64> {
    let value = text.parse::<f64>().ok().filter(|value| *value >= 0.0)?;
    let duration = SignedDuration::try_from_secs_f64(value).ok()?;
    i64::try_from(duration.as_nanos()).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ingest::testing::{START_NS, encode, picture};

    fn write(root: &Path, name: &str) {
        let path = root.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let png = encode(".png", &picture(8, 6, name.len() as u64), &[]);
        std::fs::write(path, png).unwrap();
    }

    fn address(root: &Path) -> FolderAddress {
        FolderAddress {
            path: root.to_owned(),
            rate_hz: None,
            start_utc: None,
        }
    }

    fn times_and_eyes(folder: &mut Folder) -> Vec<(i64, bool)> {
        let pairs = std::iter::from_fn(|| folder.next_pair().unwrap());
        pairs
            .map(|pair| (pair.at.unix_ns(), pair.value.right.is_some()))
            .collect()
    }

    #[test]
    fn files_named_by_time_are_paired_within_the_skew() {
        for (left, right) in TIMED {
            let root = tempfile::tempdir().unwrap();
            for ns in [START_NS, START_NS + 100, START_NS + 200_000_000] {
                write(root.path(), &format!("{left}/{ns}.png"));
            }
            write(root.path(), &format!("{right}/{}.png", START_NS + 30));
            write(
                root.path(),
                &format!("{right}/{}.png", START_NS + 205_000_000),
            );
            std::fs::write(root.path().join(left).join("data.csv"), "#timestamp").unwrap();
            let mut folder = Folder::open(&address(root.path()), 0.000_000_050).unwrap();
            let first = folder.next_pair().unwrap().unwrap();
            assert_eq!(first.value.skew, SignedDuration::from_nanos(30));
            let rest = times_and_eyes(&mut folder);
            assert_eq!(
                rest,
                [(START_NS + 100, false), (START_NS + 200_000_000, false)]
            );
            let stream = folder.counters().stream;
            assert_eq!(
                (stream.pairs, stream.left_alone, stream.right_alone),
                (1, 2, 1)
            );
        }
    }

    #[test]
    fn numbered_files_take_their_times_from_the_list_or_the_rate() {
        let root = tempfile::tempdir().unwrap();
        for number in 0..3 {
            write(root.path(), &format!("image_l/{number:06}.png"));
        }
        write(root.path(), "image_r/000000.png");
        write(root.path(), "image_r/000002.png");
        std::fs::write(root.path().join("times.txt"), "0\n0.1037\n2.07e-01\n").unwrap();
        let start_utc = Some(ServiceTime::from_unix_ns(START_NS));
        let listed = FolderAddress {
            start_utc,
            ..address(root.path())
        };
        let mut folder = Folder::open(&listed, 0.001).unwrap();
        let expected = [
            (START_NS, true),
            (START_NS + 103_700_000, false),
            (START_NS + 207_000_000, true),
        ];
        assert_eq!(times_and_eyes(&mut folder), expected);
        let steady = FolderAddress {
            rate_hz: Some(10.0),
            ..listed
        };
        let mut folder = Folder::open(&steady, 0.001).unwrap();
        let times: Vec<_> = times_and_eyes(&mut folder)
            .iter()
            .map(|(ns, _)| ns - START_NS)
            .collect();
        assert_eq!(times, [0, 100_000_000, 200_000_000]);
    }

    #[test]
    fn whole_nanoseconds_and_decimals_are_read_exactly() {
        assert_eq!(
            nanoseconds("1533429604556000001"),
            Some(1_533_429_604_556_000_001)
        );
        assert_eq!(
            nanoseconds("1533429604.556000001"),
            Some(1_533_429_604_556_000_001)
        );
        assert_eq!(nanoseconds("12"), Some(12_000_000_000));
        assert_eq!(nanoseconds("1.5e+00"), Some(1_500_000_000));
        for bad in ["-1", "nan", "inf", "1,5", "", "."] {
            assert_eq!(nanoseconds(bad), None, "{bad}");
        }
    }

    #[test]
    fn what_fits_no_layout_is_refused_with_what_would() {
        let refuse = |root: &Path| Folder::open(&address(root), 0.001).unwrap_err().to_string();
        let empty = tempfile::tempdir().unwrap();
        assert!(refuse(empty.path()).contains("image_l/ and image_r/"));
        let named = tempfile::tempdir().unwrap();
        write(named.path(), "left/frame_1.png");
        let error = refuse(named.path());
        assert!(
            error.contains("frame_1.png") && error.contains("nanoseconds"),
            "{error}"
        );
        let timeless = tempfile::tempdir().unwrap();
        write(timeless.path(), "image_l/000000.png");
        assert!(refuse(timeless.path()).contains("times.txt"));
        std::fs::write(timeless.path().join("times.txt"), "noon\n").unwrap();
        let error = refuse(timeless.path());
        assert!(
            error.contains("line 1") && error.contains("noon"),
            "{error}"
        );
        std::fs::write(timeless.path().join("times.txt"), "1\n2\n").unwrap();
        assert!(refuse(timeless.path()).contains("2 times for 1 left images"));
    }

    #[test]
    fn the_drive_of_kitti_opens_as_it_lies() {
        let shared = std::env::var_os("EMBERFIX_SHARED").map_or("../shared".into(), PathBuf::from);
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join(shared)
            .join("data/vehicle/kitti_01");
        if !path.is_dir() {
            println!("skipped: no shared data");
            return;
        }
        let address = FolderAddress {
            path,
            rate_hz: Some(10.0),
            start_utc: None,
        };
        let mut folder = Folder::open(&address, 0.001).unwrap();
        let times = times_and_eyes(&mut folder);
        assert_eq!(times.len(), 51);
        assert!(times.iter().all(|(_, both)| *both));
        assert_eq!(times[50].0, 5_000_000_000);
    }
}
