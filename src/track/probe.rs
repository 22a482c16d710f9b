use crate::eval::location::estimator::*;
use crate::eval::location::flight::*;
use crate::eval::location::law::Law;
use crate::eval::location::monte_carlo::*;
use crate::eval::location::truth::*;
use emberfix_sim::noise::{normal, stream};
use rayon::prelude::*;

fn env(name: &str, default: f64) -> f64 { std::env::var(name).ok().and_then(|v| v.parse().ok()).unwrap_or(default) }

#[test]
fn probe() {
    let kind = match std::env::var("KIND").unwrap_or_default().as_str() { "hover" => Kind::Hover, "in" => Kind::StraightIn, "by" => Kind::FlyBy, _ => Kind::Orbit };
    let gnss = if std::env::var("RTK").is_ok() { Gnss::Rtk } else { Gnss::Consumer };
    let (terrain, n) = (std::env::var("GROUND").is_ok(), env("N", 100.0) as usize);
    let (r, h) = (env("R", 60.0), env("H", 30.0));
    let runs: Vec<_> = (0..n).into_par_iter().map(|i| {
        let mut rng = stream(i as u64, "probe");
        let rng = &mut rng;
        let course = Course::drawn(rng, kind, r, h);
        let mut errors = ErrorModel::of(gnss, env("HEADING", 1.0));
        errors.pixel_px = env("PX", errors.pixel_px);
        errors.tilt_deg = env("TILT", errors.tilt_deg);
        errors.boresight_deg = env("BORE", errors.boresight_deg);
        errors.clock_s = env("CLOCK", errors.clock_s);
        errors.disparity_bias_px = env("DBIAS", errors.disparity_bias_px);
        errors.disparity_px = env("DPX", errors.disparity_px);
        errors.attitude_noise_rad = env("JIT", errors.attitude_noise_rad);
        errors.position_noise_m = env("POS", errors.position_noise_m);
        errors.lever_arm_m = env("LEVER", errors.lever_arm_m);
        let slope = (0.0, 0.0);
        let ground = ground_at_datum(slope, GROUND_SIGMA_M);
        let error_m = GROUND_SIGMA_M * normal(rng);
        let flame = Flame { base_m: on_ground(&ground, 0.0, 0.0, 0.0), size_m: (r / 40.0).max(1.0) };
        let known = Ground { height_m: ground.height_m - error_m, ..ground };
        let lens = Lens { depression_deg: course.mean_depression_deg().clamp(0.0, 90.0), ..if std::env::var("WIDE").is_ok() { Lens::wide() } else { Lens::short() } };
        let times = course.looks(80, 0.33);
        let scene = Scene { course: &course, lens, flame, ground: terrain.then_some(known), errors: &errors, law: Law::Assumed, times_s: &times };
        let staged = stage(&scene, rng);
        let mut pilot = Pilot::new(&staged.lens, &errors, staged.ground).unwrap();
        let mut out = vec![];
        for look in &staged.looks {
            pilot.look(&look.autopilot, look.seen.as_slice());
            let told = pilot.fires();
            out.push(told.into_iter().next().map(|f| {
                let e = (f.position_m - flame.base_m).xy();
                let c = f.covariance_m2.fixed_view::<2, 2>(0, 0).into_owned();
                let q = c.try_inverse().map_or(1e9, |i| e.dot(&(i * e)));
                let look_dir = -(look.truth.state.position_m - flame.base_m).xy().normalize();
                let along = e.dot(&look_dir);
                let va = look_dir.dot(&(c * look_dir)).sqrt();
                let x = nalgebra::Vector2::new(-look_dir.y, look_dir.x);
                (q, along, va, e.dot(&x), x.dot(&(c * x)).sqrt(), e.norm(), c.trace())
            }));
        }
        (out, pilot.fires().len())
    }).collect();
    println!("fires != 1: {}", runs.iter().filter(|r| r.1 != 1).count());
    for k in [0, 1, 2, 4, 8, 16, 32, 79] {
        let of: Vec<_> = runs.iter().filter_map(|r| r.0.get(k).copied().flatten()).collect();
        let m = of.len() as f64;
        let mean = |f: &dyn Fn(&(f64, f64, f64, f64, f64, f64, f64)) -> f64| of.iter().map(f).sum::<f64>() / m;
        println!("look {k:3} n {m} anees/2 {:.2} in90 {:.3} | along mean z {:.2} var z {:.2} rms {:.2} sd {:.2} | across z {:.2} rms {:.2} sd {:.2} | rms/pred {:.2}",
            mean(&|r| r.0) / 2.0, mean(&|r| f64::from(r.0 < 4.605)), mean(&|r| r.1 / r.2), mean(&|r| (r.1 / r.2).powi(2)), mean(&|r| r.1 * r.1).sqrt(), mean(&|r| r.2 * r.2).sqrt(),
            mean(&|r| (r.3 / r.4).powi(2)), mean(&|r| r.3 * r.3).sqrt(), mean(&|r| r.4 * r.4).sqrt(), (mean(&|r| r.5 * r.5) / mean(&|r| r.6)).sqrt());
    }
}
