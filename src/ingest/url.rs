//! Camera URLs: one line of the mission that says where images come from.

use super::camera::{self, CaptureAddress, CaptureDevice, CaptureFormat};
use super::folder::{Folder, FolderAddress};
use super::socket::{self, SocketAddress};
use super::{Expected, Recording, SourceError, StereoSource};
use emberfix_frames::ServiceTime;
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::Arc;

/// Reads the service clock.
pub type ServiceClock = Arc<dyn Fn() -> ServiceTime + Send + Sync>;

/// Where images come from.
#[derive(Debug, Clone, PartialEq)]
pub enum CameraUrl {
    /// A live MCAP stream.
    Socket(SocketAddress),
    /// A camera, or a video file, through OpenCV.
    Capture(CaptureAddress),
    /// A folder of images.
    Folder(FolderAddress),
    /// A recording, for its pairs alone.
    Recording(PathBuf),
}

const FORMS: &str = "tcp-listen:HOST:PORT, tcp-connect:HOST:PORT, unix-listen:PATH, \
                     unix-connect:PATH, v4l2:/dev/video0?layout=side-by-side, \
                     v4l2:/dev/video0,/dev/video2 (left, right; both with \
                     &width=&height=&fps= if wanted), gstreamer:PIPELINE ! appsink, \
                     video:FILE?start_utc=, folder:PATH?rate_hz=&start_utc=, recording:FILE.mcap";

/// Why a camera URL was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CameraUrlError {
    /// No form that we know.
    #[error("camera url {url:?} has none of the forms {FORMS}")]
    Form {
        /// What was given.
        url: String,
    },
    /// An option that the form does not have, or a value that it can't have.
    #[error("camera url {url:?}: option {option:?} must be {allowed}")]
    Option {
        /// What was given.
        url: String,
        /// The offending `key=value`.
        option: String,
        /// What would have been accepted.
        allowed: &'static str,
    },
}

impl FromStr for CameraUrl {
    type Err = CameraUrlError;

    fn from_str(url: &str) -> Result<Self, CameraUrlError> {
        let unknown = || CameraUrlError::Form {
            url: url.to_owned(),
        };
        let (scheme, rest) = url.split_once(':').ok_or_else(unknown)?;
        if rest.is_empty() {
            return Err(unknown());
        }
        let host_port = || {
            let port = rest.rsplit_once(':').filter(|(host, _)| !host.is_empty());
            let is_port = port.is_some_and(|(_, port)| port.parse::<u16>().is_ok());
            is_port.then(|| rest.to_owned()).ok_or_else(unknown)
        };
        Ok(match scheme {
            "tcp-listen" => Self::Socket(SocketAddress::TcpListen(host_port()?)),
            "tcp-connect" => Self::Socket(SocketAddress::TcpConnect(host_port()?)),
            "unix-listen" => Self::Socket(SocketAddress::UnixListen(rest.into())),
            "unix-connect" => Self::Socket(SocketAddress::UnixConnect(rest.into())),
            "v4l2" => Self::Capture(v4l2(url, rest)?),
            "gstreamer" => Self::Capture(CaptureAddress {
                device: CaptureDevice::Gstreamer(rest.to_owned()),
                format: CaptureFormat::default(),
            }),
            "video" => Self::Capture(video(url, rest)?),
            "folder" => Self::Folder(folder(url, rest)?),
            "recording" => Self::Recording(rest.into()),
            _ => return Err(unknown()),
        })
    }
}

/// `PATH?key=value&key=value`.
struct Options<'a> {
    url: &'a str,
    pairs: Vec<(&'a str, &'a str)>,
}

impl<'a> Options<'a> {
    fn split(
        url: &'a str,
        rest: &'a str,
        known: &'static str,
    ) -> Result<(&'a str, Self), CameraUrlError> {
        let (path, query) = rest.split_once('?').unwrap_or((rest, ""));
        let mut pairs = Vec::new();
        for option in query.split('&').filter(|option| !option.is_empty()) {
            let pair = option.split_once('=');
            let pair = pair.filter(|(key, _)| known.split(", ").any(|name| name == *key));
            pairs.push(pair.ok_or_else(|| refused(url, option, known))?);
        }
        Ok((path, Self { url, pairs }))
    }

    fn get<T>(
        &self,
        key: &str,
        allowed: &'static str,
        read: impl Fn(&str) -> Option<T>,
    ) -> Result<Option<T>, CameraUrlError> {
        let Some((key, value)) = self.pairs.iter().find(|(name, _)| *name == key) else {
            return Ok(None);
        };
        let value_read = read(value);
        value_read
            .map(Some)
            .ok_or_else(|| refused(self.url, &format!("{key}={value}"), allowed))
    }
}

fn refused(url: &str, option: &str, allowed: &'static str) -> CameraUrlError {
    CameraUrlError::Option {
        url: url.to_owned(),
        option: option.to_owned(),
        allowed,
    }
}

const RATE: &str = "a rate above 0 and up to 1000 Hz";
const UTC: &str = "an RFC 3339 time such as 2026-03-01T12:00:00Z";
const PIXELS: &str = "1 to 16384 pixels";

fn rate(text: &str) -> Option<f64> {
    text.parse().ok().filter(|hz| *hz > 0.0 && *hz <= 1000.0)
}

fn pixels(text: &str) -> Option<u32> {
    text.parse().ok().filter(|px| (1..=16_384).contains(px))
}

fn folder(url: &str, rest: &str) -> Result<FolderAddress, CameraUrlError> {
    let (path, options) = Options::split(url, rest, "rate_hz, start_utc")?;
    Ok(FolderAddress {
        path: path.into(),
        rate_hz: options.get("rate_hz", RATE, rate)?,
        start_utc: options.get("start_utc", UTC, ServiceTime::from_rfc3339)?,
    })
}

fn video(url: &str, rest: &str) -> Result<CaptureAddress, CameraUrlError> {
    let (path, options) = Options::split(url, rest, "layout, start_utc")?;
    layout(&options)?;
    let start_utc = options.get("start_utc", UTC, ServiceTime::from_rfc3339)?;
    let start = start_utc.unwrap_or(ServiceTime::from_unix_ns(0));
    Ok(CaptureAddress {
        device: CaptureDevice::File {
            path: path.into(),
            start,
        },
        format: CaptureFormat::default(),
    })
}

fn v4l2(url: &str, rest: &str) -> Result<CaptureAddress, CameraUrlError> {
    let (path, options) = Options::split(url, rest, "layout, width, height, fps")?;
    let format = CaptureFormat {
        width: options.get("width", PIXELS, pixels)?,
        height: options.get("height", PIXELS, pixels)?,
        fps: options.get("fps", RATE, rate)?,
    };
    let device = match path.split(',').collect::<Vec<_>>()[..] {
        [left, right] if options.pairs.iter().all(|(key, _)| *key != "layout") => {
            CaptureDevice::TwoV4l2 {
                left: left.to_owned(),
                right: right.to_owned(),
            }
        }
        [_] => {
            layout(&options)?;
            CaptureDevice::V4l2(path.to_owned())
        }
        _ => {
            return Err(CameraUrlError::Form {
                url: url.to_owned(),
            });
        }
    };
    Ok(CaptureAddress { device, format })
}

/// One device shows both eyes in one frame, and there is one way to do so.
fn layout(options: &Options<'_>) -> Result<(), CameraUrlError> {
    let side_by_side = |text: &str| (text == "side-by-side").then_some(());
    options
        .get("layout", "side-by-side", side_by_side)
        .map(drop)
}

/// Opens what a URL names, for what is expected of it: a rig's images, or any.
///
/// # Errors
/// [`SourceError`] when it can't be opened, or does not fit the rig. A live peer that is not there
/// yet is no error: it is awaited.
pub fn open(
    url: &CameraUrl,
    expected: &Expected,
    clock: ServiceClock,
) -> Result<Box<dyn StereoSource>, SourceError> {
    let skew_s = expected.max_skew_s;
    match url {
        CameraUrl::Socket(address) => socket::open(address, expected, clock),
        CameraUrl::Capture(address) => camera::open(address, expected, clock),
        CameraUrl::Folder(address) => Ok(Box::new(Folder::open(address, skew_s)?)),
        CameraUrl::Recording(path) => Ok(Box::new(Recording::open_with_skew(path, skew_s)?)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_form_is_read() {
        let read = |url: &str| url.parse::<CameraUrl>().unwrap();
        let socket = |address| CameraUrl::Socket(address);
        assert_eq!(
            read("tcp-listen:[::1]:5600"),
            socket(SocketAddress::TcpListen("[::1]:5600".to_owned()))
        );
        assert_eq!(
            read("tcp-connect:camera.local:5600"),
            socket(SocketAddress::TcpConnect("camera.local:5600".to_owned()))
        );
        assert_eq!(
            read("unix-listen:/run/a"),
            socket(SocketAddress::UnixListen("/run/a".into()))
        );
        assert_eq!(
            read("unix-connect:a"),
            socket(SocketAddress::UnixConnect("a".into()))
        );
        assert_eq!(
            read("recording:a.mcap"),
            CameraUrl::Recording("a.mcap".into())
        );
        let CameraUrl::Capture(v4l2) =
            read("v4l2:/dev/video0?layout=side-by-side&width=2560&fps=30")
        else {
            unreachable!()
        };
        assert_eq!(v4l2.device, CaptureDevice::V4l2("/dev/video0".to_owned()));
        assert_eq!(
            (v4l2.format.width, v4l2.format.fps),
            (Some(2560), Some(30.0))
        );
        let CameraUrl::Capture(two) = read("v4l2:/dev/video0,/dev/video2") else {
            unreachable!()
        };
        assert!(
            matches!(two.device, CaptureDevice::TwoV4l2 { right, .. } if right == "/dev/video2")
        );
        let pipeline = "v4l2src device=/dev/video0 ! video/x-raw,width=2560 ! appsink";
        let CameraUrl::Capture(gst) = read(&format!("gstreamer:{pipeline}")) else {
            unreachable!()
        };
        assert_eq!(gst.device, CaptureDevice::Gstreamer(pipeline.to_owned()));
        let CameraUrl::Folder(folder) =
            read("folder:a/b?rate_hz=10&start_utc=2026-03-01T12:00:00Z")
        else {
            unreachable!()
        };
        assert_eq!(
            (folder.path, folder.rate_hz),
            (PathBuf::from("a/b"), Some(10.0))
        );
        assert_eq!(
            folder.start_utc,
            ServiceTime::from_rfc3339("2026-03-01T12:00:00Z")
        );
    }

    #[test]
    fn anything_else_is_refused_with_all_forms_named() {
        for url in [
            "",
            "folder:",
            "rtsp://camera",
            "tcp-listen:5600",
            "tcp-listen:a:99999",
            "v4l2:a,b,c",
        ] {
            let error = url.parse::<CameraUrl>().unwrap_err().to_string();
            assert!(
                error.contains("unix-listen:PATH") && error.contains("recording:"),
                "{error}"
            );
        }
    }

    #[test]
    fn a_bad_option_is_named_with_what_it_may_be() {
        let refuse = |url: &str| url.parse::<CameraUrl>().unwrap_err().to_string();
        assert!(refuse("folder:a?rate_hz=0").contains("rate_hz=0"));
        assert!(refuse("folder:a?rate=10").contains("rate_hz, start_utc"));
        assert!(refuse("v4l2:/dev/video0?layout=top-bottom").contains("side-by-side"));
        assert!(refuse("folder:a?start_utc=yesterday").contains("RFC 3339"));
    }
}
