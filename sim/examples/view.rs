//! Renders one stereo pair of a small world and says how long it took.
//!
//! `cargo run --release -p emberfix-sim --example view -- OUT_PREFIX RANGE_M UP_M BANK_DEG PAIRS`

use emberfix_calib::{Eye, Rig};
use emberfix_sim::render::{RenderConfig, Renderer, StereoCamera};
use emberfix_sim::state::BodyState;
use emberfix_sim::world::{World, WorldConfig};
use nalgebra::{Matrix3, Rotation3, Vector3};
use std::sync::Arc;
use std::time::Instant;

const WORLD: &str = r#"
terrain = { kind = "hills", amplitude_m = 3.0, wavelength_m = 160.0, seed = 4 }
ground = ["grass", "straw", "soil"]
trees = { count = 150, seed = 3, height_m = 5.0, spread_m = 120.0 }
[[fires]]
name = "a"
east_m = 0.0
north_m = 0.0
width_m = 1.2
height_m = 1.8
smoke = true
[[fires]]
name = "b"
east_m = 12.0
north_m = 14.0
width_m = 3.0
height_m = 2.5
[[smokes]]
name = "c"
east_m = -25.0
north_m = 30.0
width_m = 2.0
height_m = 20.0
[[lookalikes]]
kind = "red_roof"
east_m = -14.0
north_m = 12.0
size_m = 8.0
[[lookalikes]]
kind = "orange_vehicle"
east_m = 6.0
north_m = -3.0
size_m = 4.0
[[lookalikes]]
kind = "sun_glint"
east_m = -6.0
north_m = 2.0
size_m = 3.0
[[lookalikes]]
kind = "lantern"
east_m = 3.5
north_m = 3.0
size_m = 0.3
"#;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [prefix, range, up, bank, pairs] = arguments.as_slice() else {
        anyhow::bail!("usage: view OUT_PREFIX RANGE_M UP_M BANK_DEG PAIRS");
    };
    let (range_m, up_m, bank_deg): (f64, f64, f64) = (range.parse()?, up.parse()?, bank.parse()?);
    let rig =
        Rig::load(concat!(env!("CARGO_MANIFEST_DIR"), "/../calib/rigs/oakd-75mm.toml").as_ref())?;
    let config: WorldConfig = toml::from_str(WORLD)?;
    let world = Arc::new(World::new(&config, 7)?);
    let renderer = Renderer::new(world, StereoCamera::new(&rig), RenderConfig::default());
    let body = BodyState {
        t_s: 3.0,
        position_m: Vector3::new(0.0, -range_m, up_m),
        enu_from_body: north_facing(bank_deg),
        velocity_m_s: Vector3::zeros(),
        rate_rad_s: Vector3::zeros(),
    };
    for (eye, name) in [(Eye::Left, "left"), (Eye::Right, "right")] {
        let started = Instant::now();
        let frame = renderer.render(eye, &body, 3.0);
        println!("{name}: {:.1} ms", started.elapsed().as_secs_f64() * 1e3);
        image::save_buffer(
            format!("{prefix}-{name}.png"),
            &frame.rgb(),
            frame.width,
            frame.height,
            image::ExtendedColorType::Rgb8,
        )?;
    }
    let started = Instant::now();
    for label in renderer.label_boxes(&body, 3.0) {
        println!("{label:?}");
    }
    println!("labels: {:.1} ms", started.elapsed().as_secs_f64() * 1e3);
    let started = Instant::now();
    let pairs: u32 = pairs.parse()?;
    for k in 0..pairs {
        let t_s = 3.0 + f64::from(k) / 10.0;
        std::hint::black_box((
            renderer.render(Eye::Left, &body, t_s),
            renderer.render(Eye::Right, &body, t_s),
        ));
    }
    println!(
        "{:.1} ms a pair",
        started.elapsed().as_secs_f64() * 1e3 / f64::from(pairs.max(1))
    );
    Ok(())
}

/// Level flight to the north, then banked to the right.
fn north_facing(bank_deg: f64) -> Matrix3<f64> {
    let level = Matrix3::new(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0);
    level * Rotation3::from_axis_angle(&Vector3::x_axis(), bank_deg.to_radians()).into_inner()
}
