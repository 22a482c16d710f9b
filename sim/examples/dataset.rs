//! Writes labelled pictures: `dataset DIR PICTURES SEED`.

use emberfix_calib::Rig;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [dir, pictures, seed] = arguments.as_slice() else {
        anyhow::bail!("usage: dataset DIR PICTURES SEED");
    };
    let rig =
        Rig::load(concat!(env!("CARGO_MANIFEST_DIR"), "/../calib/rigs/oakd-75mm.toml").as_ref())?;
    let summary =
        emberfix_sim::dataset::write(dir.as_ref(), pictures.parse()?, seed.parse()?, &rig)?;
    println!("{summary:?}");
    Ok(())
}
