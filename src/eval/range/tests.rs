use super::stage::*;
use super::*;
use opencv::core::{Mat, MatTraitConst, Rect};
use opencv::imgcodecs::imwrite_def;

#[test]
fn look() {
    let world = stage::world().unwrap();
    let dir = std::path::Path::new("/root/scratch/rangelook");
    std::fs::create_dir_all(dir).unwrap();
    let save = |name: &str, trial: &Trial| {
        let b = trial.target.box_px;
        let whole = Rect::new(0, 0, trial.pair.left_bgr.cols(), trial.pair.left_bgr.rows());
        let r = Rect::new(
            b.x as i32 - 150,
            b.y as i32 - 60,
            b.width as i32 + 300,
            b.height as i32 + 120,
        ) & whole;
        let mut out = Mat::default();
        let left = trial.pair.left_bgr.roi(r).unwrap().try_clone().unwrap();
        let mut right = Mat::default();
        match &trial.pair.right_gray {
            Some(g) => opencv::imgproc::cvt_color_def(
                &g.roi(r).unwrap(),
                &mut right,
                opencv::imgproc::COLOR_GRAY2BGR,
            )
            .unwrap(),
            None => right = left.clone(),
        }
        opencv::core::hconcat2(&left, &right, &mut out).unwrap();
        imwrite_def(dir.join(format!("{name}.png")), &out).unwrap();
        println!(
            "{name}: {:?} truth {:.3}",
            b,
            trial.truth.disparity_px(trial.truth.row())
        );
    };
    let stage = Stage::new(RigName::Ours120, &world).unwrap();
    for case in cases::Hardness::ALL {
        for k in 0..2 {
            let t = std::time::Instant::now();
            let trial = stage
                .trial(&case.recipe(), SeedSet::Tuning, 77 + k)
                .unwrap()
                .unwrap();
            println!("{:?}", t.elapsed());
            save(&format!("{}_{k}", case.name()), &trial);
        }
    }
    for s in &tables::ALL {
        let stage = Stage::new(s.rig, &world).unwrap();
        for d in [
            s.distances_m[0],
            s.distances_m[s.distances_m.len() / 2],
            s.distances_m[s.distances_m.len() - 1],
        ] {
            let t = std::time::Instant::now();
            let trial = stage
                .trial(&s.recipe(d), SeedSet::Tuning, 5)
                .unwrap()
                .unwrap();
            println!("{:?}", t.elapsed());
            save(&format!("{}_{d}", s.name.replace(' ', "_")), &trial);
        }
    }
}
