//! Our values as Foxglove messages. Pure.

use super::{BodyPose, UavFix};
use crate::detect::{Detection, DetectionClass};
use crate::ingest::{EncodedImage, ImageEncoding};
use emberfix_calib::{Camera, Eye, Rig};
use emberfix_frames::{Metres, ServiceTime, UnitQuaternion, Vector3, Wgs84Parts, rotation_matrix};
use foxglove::messages::location_fix::PositionCovarianceType;
use foxglove::messages::points_annotation::Type as PointsType;
use foxglove::messages::{
    CameraCalibration, Color, CompressedImage, FrameTransform, ImageAnnotations, LocationFix,
    Point2, PointsAnnotation, Quaternion, RawImage, TextAnnotation, Timestamp,
    Vector3 as FoxgloveVector,
};

/// Tangent plane at the mission datum: east, north, up.
const MISSION_FRAME: &str = "mission_enu";
/// Airframe: forward, right, down; origin at the autopilot's IMU.
const BODY_FRAME: &str = "body_frd";
/// Rectified left camera: right, down, boresight.
const LEFT_FRAME: &str = "stereo_left_rectified";

/// Frame of an eye's raw image: right, down, boresight.
fn optical_frame(eye: Eye) -> String {
    match eye {
        Eye::Left => "stereo_left_optical".to_owned(),
        Eye::Right => "stereo_right_optical".to_owned(),
    }
}

/// A time as Foxglove has it; outside 1970 to 2106 it saturates.
fn timestamp(at: ServiceTime) -> Timestamp {
    let ns = at.unix_ns_u64();
    let seconds = u32::try_from(ns / 1_000_000_000).unwrap_or(u32::MAX);
    let rest = u32::try_from(ns % 1_000_000_000).unwrap_or(0);
    Timestamp::new_checked(seconds, rest).unwrap_or(Timestamp::MAX)
}

/// An eye's image: compressed or raw, as it came.
pub(super) enum ImageMessage {
    Compressed(CompressedImage),
    Raw(RawImage),
}

pub(super) fn image(eye: Eye, image: &EncodedImage) -> ImageMessage {
    let compressed = |format: &str| {
        ImageMessage::Compressed(CompressedImage {
            timestamp: Some(timestamp(image.at)),
            frame_id: optical_frame(eye),
            data: image.bytes.clone(),
            format: format.to_owned(),
        })
    };
    match &image.encoding {
        ImageEncoding::Jpeg => compressed("jpeg"),
        ImageEncoding::Png => compressed("png"),
        ImageEncoding::Raw {
            encoding,
            width,
            height,
            step,
        } => ImageMessage::Raw(RawImage {
            timestamp: Some(timestamp(image.at)),
            frame_id: optical_frame(eye),
            width: *width,
            height: *height,
            encoding: encoding.clone(),
            step: *step,
            data: image.bytes.clone(),
        }),
    }
}

/// An eye's calibration. K and D count; R and P are those of our rectification, for viewers.
pub(super) fn calibration(rig: &Rig, eye: Eye, at: ServiceTime) -> CameraCalibration {
    let Camera {
        image_size_px,
        focal_px: (fx, fy),
        principal_point_px: (cx, cy),
        distortion,
    } = rig.camera(eye);
    let rectification = rig.rectification();
    let (focal, (cx_left, cy_rectified)) =
        (rectification.focal_px(), rectification.principal_point_px());
    let (cx_rectified, shift) = match eye {
        Eye::Left => (cx_left, 0.0),
        Eye::Right => (
            cx_left - rectification.infinity_disparity_px(),
            -focal * rig.baseline_m(),
        ),
    };
    let turn = rectification.rectified_from_raw(eye).transpose();
    CameraCalibration {
        timestamp: Some(timestamp(at)),
        frame_id: optical_frame(eye),
        width: image_size_px.0,
        height: image_size_px.1,
        distortion_model: "plumb_bob".to_owned(),
        d: distortion.to_vec(),
        k: vec![*fx, 0.0, *cx, 0.0, *fy, *cy, 0.0, 0.0, 1.0],
        r: turn.as_slice().to_vec(), // the transpose, column-major: row-major
        p: [
            focal,
            0.0,
            cx_rectified,
            shift,
            0.0,
            focal,
            cy_rectified,
            0.0,
            0.0,
            0.0,
            1.0,
            0.0,
        ]
        .to_vec(),
    }
}

pub(super) fn location_fix(at: ServiceTime, fix: &UavFix) -> LocationFix {
    LocationFix {
        timestamp: Some(timestamp(at)),
        frame_id: BODY_FRAME.to_owned(),
        latitude: fix.place.latitude_deg(),
        longitude: fix.place.longitude_deg(),
        altitude: fix.place.height().m(),
        position_covariance: fix.covariance.row_major().to_vec(),
        position_covariance_type: PositionCovarianceType::Known.into(),
        heading: fix.heading_rad,
        ..LocationFix::default()
    }
}

/// Mission plane to body, as it flies; body to rectified left camera, as it is mounted.
pub(super) fn transforms(at: ServiceTime, pose: &BodyPose, rig: &Rig) -> [FrameTransform; 2] {
    let mounted = UnitQuaternion::from_matrix(&rotation_matrix(&rig.body_from_cam_left()));
    let transform = |parent: &str, child: &str, at_m: Vector3<f64>, turn| FrameTransform {
        timestamp: Some(timestamp(at)),
        parent_frame_id: parent.to_owned(),
        child_frame_id: child.to_owned(),
        translation: Some(FoxgloveVector {
            x: at_m.x,
            y: at_m.y,
            z: at_m.z,
        }),
        rotation: Some(quaternion(&turn)),
    };
    [
        transform(
            MISSION_FRAME,
            BODY_FRAME,
            pose.position_enu_m,
            pose.enu_from_body,
        ),
        transform(BODY_FRAME, LEFT_FRAME, rig.lever_arm().metres(), mounted),
    ]
}

fn quaternion(turn: &UnitQuaternion<f64>) -> Quaternion {
    Quaternion {
        x: turn.i,
        y: turn.j,
        z: turn.k,
        w: turn.w,
    }
}

/// Boxes with class and score, in pixels of the raw left image.
pub(super) fn annotations(at: ServiceTime, detections: &[Detection]) -> ImageAnnotations {
    ImageAnnotations {
        timestamp: Some(timestamp(at)),
        points: detections
            .iter()
            .map(|detection| outline(at, detection))
            .collect(),
        texts: detections
            .iter()
            .map(|detection| caption(at, detection))
            .collect(),
        ..ImageAnnotations::default()
    }
}

fn outline(at: ServiceTime, detection: &Detection) -> PointsAnnotation {
    let edges = detection.box_px;
    let (right, bottom) = (edges.x + edges.width, edges.y + edges.height);
    let corners = [
        (edges.x, edges.y),
        (right, edges.y),
        (right, bottom),
        (edges.x, bottom),
    ];
    PointsAnnotation {
        timestamp: Some(timestamp(at)),
        r#type: PointsType::LineLoop.into(),
        points: corners.map(|(x, y)| Point2 { x, y }).to_vec(),
        outline_color: Some(colour(detection.class)),
        thickness: 2.0,
        ..PointsAnnotation::default()
    }
}

fn caption(at: ServiceTime, detection: &Detection) -> TextAnnotation {
    let name = match detection.class {
        DetectionClass::Fire => "fire",
        DetectionClass::Smoke => "smoke",
        DetectionClass::NonFire => "not fire",
    };
    TextAnnotation {
        timestamp: Some(timestamp(at)),
        position: Some(Point2 {
            x: detection.box_px.x,
            y: detection.box_px.y,
        }),
        text: format!("{name} {:.2}", detection.score),
        font_size: 14.0,
        text_color: Some(colour(detection.class)),
        ..TextAnnotation::default()
    }
}

fn colour(class: DetectionClass) -> Color {
    match class {
        DetectionClass::Fire => Color {
            r: 1.0,
            g: 0.25,
            b: 0.0,
            a: 1.0,
        },
        DetectionClass::Smoke => Color {
            r: 0.7,
            g: 0.7,
            b: 0.7,
            a: 1.0,
        },
        DetectionClass::NonFire => Color {
            r: 0.2,
            g: 0.6,
            b: 1.0,
            a: 1.0,
        },
    }
}
