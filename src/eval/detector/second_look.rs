//! Whether a second look tells rendered flames from what looks like them.

use super::events::{RightEye, rig};
use crate::detect::{BoxPx, DetectError, Detection, DetectionClass, Detector, LeftImage, Twice};
use emberfix_calib::Eye;
use emberfix_frames::ServiceTime;
use emberfix_sim::render::{RenderConfig, Renderer, StereoCamera};
use emberfix_sim::state::BodyState;
use emberfix_sim::world::{FireConfig, LookalikeConfig, LookalikeKind, World, WorldConfig};
use nalgebra::{Matrix3, Vector3};
use opencv::core::{Mat, MatTraitConst};
use std::sync::Arc;

/// Says the same of every image.
struct Always(Vec<Detection>);

impl Detector for Always {
    fn detect(&mut self, _image: &LeftImage) -> Result<Vec<Detection>, DetectError> {
        Ok(self.0.clone())
    }
}

fn fire_at(box_px: BoxPx) -> Detection {
    Detection {
        class: DetectionClass::Fire,
        score: 0.6,
        box_px,
        mask: None,
        second_look: None,
    }
}

/// What stands in the middle of the ground from 30 m, 30 degrees down.
fn picture(config: &WorldConfig) -> LeftImage {
    let world = Arc::new(World::new(config, 5).unwrap());
    let camera = StereoCamera::new(&rig(RightEye::Visible).unwrap());
    let renderer = Renderer::new(world, camera, RenderConfig::default());
    let (sin, cos) = 30.0_f64.to_radians().sin_cos();
    #[rustfmt::skip]
    let enu_from_body = Matrix3::new(
        0.0, 1.0, 0.0,
        1.0, 0.0, 0.0,
        0.0, 0.0, -1.0,
    );
    let body = BodyState {
        t_s: 100.0,
        position_m: Vector3::new(0.0, -30.0 * cos, 30.0 * sin),
        enu_from_body,
        velocity_m_s: Vector3::zeros(),
        rate_rad_s: Vector3::zeros(),
    };
    let frame = renderer.render(Eye::Left, &body, body.t_s);
    let bytes = Mat::from_slice(&frame.bytes).unwrap().clone_pointee();
    LeftImage {
        at: ServiceTime::from_unix_ns(0),
        sequence: 0,
        bgr: bytes.reshape(3, 416).unwrap().clone_pointee(),
        ground: None,
    }
}

fn judged(config: &WorldConfig, side_px: f64) -> f64 {
    let box_px = BoxPx {
        x: 208.0 - side_px / 2.0,
        y: 208.0 - 0.8 * side_px,
        width: side_px,
        height: side_px,
    };
    let mut detector = Twice::open(Always(vec![fire_at(box_px)])).unwrap();
    let found = detector.detect(&picture(config)).unwrap();
    found[0].second_look.unwrap()
}

#[test]
fn a_flame_is_told_from_a_lantern_and_from_a_car() {
    let fire = FireConfig {
        name: "fire".to_owned(),
        east_m: 0.0,
        north_m: 0.0,
        width_m: 1.2,
        height_m: 1.5,
        smoke: false,
        ignites_at_s: -60.0,
        growth_m_s: 0.0,
    };
    let burning = judged(
        &WorldConfig {
            fires: vec![fire],
            ..WorldConfig::default()
        },
        40.0,
    );
    let not_burning = |kind, size_m, side_px| {
        let thing = LookalikeConfig {
            kind,
            east_m: 0.0,
            north_m: 0.0,
            size_m,
        };
        let lookalikes = vec![thing];
        judged(
            &WorldConfig {
                lookalikes,
                ..WorldConfig::default()
            },
            side_px,
        )
    };
    let lantern = not_burning(LookalikeKind::Lantern, 0.5, 24.0);
    let car = not_burning(LookalikeKind::OrangeVehicle, 4.0, 100.0);
    assert!(burning > 0.0, "{burning}");
    assert!(lantern < 0.0 && car < 0.0, "lantern {lantern}, car {car}");
}
