//! The `[terrain]` table: a plane, or tiles.

use crate::locate::{Area, ConstantPlane, Terrain, TileSigmas, VerticalDatum};
use crate::terrain::{TileSource, load};
use emberfix_calib::Checks;
use emberfix_frames::{EllipsoidHeight, Wgs84, Wgs84Parts};
use serde::Deserialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;

#[derive(Deserialize)]
pub(super) struct RawTerrain {
    kind: String,
    sigma_m: f64,
    height_ellipsoid_m: Option<f64>,
    #[serde(default)]
    paths: Vec<PathBuf>,
    vertical_datum: Option<String>,
    horizontal_sigma_m: Option<f64>,
    canopy_m: Option<f64>,
    reach_m: Option<f64>,
}

/// Where a post of SRTM or Copernicus lies, one sigma, metres.
const HORIZONTAL_SIGMA_M: f64 = 5.0;
/// Ground further from the mission datum is not kept, metres.
const REACH_M: f64 = 20_000.0;
const DATUMS: [VerticalDatum; 3] = [
    VerticalDatum::Egm96,
    VerticalDatum::Egm2008,
    VerticalDatum::Ellipsoid,
];

impl RawTerrain {
    pub(super) fn check(&self, checks: &mut Checks) {
        checks.range(
            "terrain.sigma_m",
            self.sigma_m,
            0.05,
            500.0,
            " (never perfectly flat)",
        );
        match self.kind.as_str() {
            "plane" => self.check_plane(checks),
            "tiles" => self.check_tiles(checks),
            other => checks.problem(format!(
                "terrain.kind is {other:?}, allowed are \"plane\" and \"tiles\""
            )),
        }
    }

    fn check_plane(&self, checks: &mut Checks) {
        match self.height_ellipsoid_m {
            Some(height) => {
                checks.range("terrain.height_ellipsoid_m", height, -500.0, 9000.0, "");
            }
            None => checks
                .problem("terrain.height_ellipsoid_m is missing, which a plane needs".to_owned()),
        }
        let of_tiles = [
            ("paths", !self.paths.is_empty()),
            ("vertical_datum", self.vertical_datum.is_some()),
            ("horizontal_sigma_m", self.horizontal_sigma_m.is_some()),
            ("canopy_m", self.canopy_m.is_some()),
            ("reach_m", self.reach_m.is_some()),
        ];
        for (key, _) in of_tiles.iter().filter(|(_, set)| *set) {
            checks.problem(format!(
                "terrain.{key} is for kind \"tiles\", not for a plane"
            ));
        }
    }

    fn check_tiles(&self, checks: &mut Checks) {
        if self.paths.is_empty() {
            checks.problem(
                "terrain.paths is missing: a list of GeoTIFF files or of folders of them"
                    .to_owned(),
            );
        }
        if self.height_ellipsoid_m.is_some() {
            checks.problem(
                "terrain.height_ellipsoid_m is for kind \"plane\", tiles have their own".to_owned(),
            );
        }
        if let Some(name) = &self.vertical_datum
            && datum_named(name).is_none()
        {
            checks.problem(format!(
                "terrain.vertical_datum is {name:?}, allowed are \"egm96\", \"egm2008\" and \"ellipsoid\""
            ));
        }
        let sigmas = self.sigmas();
        checks.range(
            "terrain.horizontal_sigma_m",
            sigmas.horizontal_m,
            0.0,
            500.0,
            "",
        );
        checks.range("terrain.canopy_m", sigmas.canopy_m, 0.0, 100.0, "");
        checks.range("terrain.reach_m", self.reach_m(), 1_000.0, 200_000.0, "");
    }

    fn sigmas(&self) -> TileSigmas {
        TileSigmas {
            vertical_m: self.sigma_m,
            horizontal_m: self.horizontal_sigma_m.unwrap_or(HORIZONTAL_SIGMA_M),
            canopy_m: self.canopy_m.unwrap_or(0.0),
        }
    }

    fn reach_m(&self) -> f64 {
        self.reach_m.unwrap_or(REACH_M)
    }

    /// The terrain about the mission datum; checked before.
    ///
    /// # Errors
    /// One sentence for each tile that was refused.
    pub(super) fn build(
        &self,
        datum: &Wgs84,
        beside: &dyn Fn(&Path) -> PathBuf,
    ) -> Result<Arc<dyn Terrain>, Vec<String>> {
        if let Some(height) = self.height_ellipsoid_m {
            return Ok(Arc::new(ConstantPlane {
                height: EllipsoidHeight::from_m(height),
                sigma_m: self.sigma_m,
            }));
        }
        let source = TileSource {
            paths: self.paths.iter().map(|path| beside(path)).collect(),
            datum: self.vertical_datum.as_deref().and_then(datum_named),
            sigmas: self.sigmas(),
            near: Area::around(datum.latitude_deg(), datum.longitude_deg(), self.reach_m()),
        };
        match load(&source) {
            Ok(tiles) => Ok(Arc::new(tiles)),
            Err(problems) => Err(problems
                .iter()
                .map(|problem| format!("terrain: {problem}"))
                .collect()),
        }
    }
}

fn datum_named(name: &str) -> Option<VerticalDatum> {
    DATUMS.into_iter().find(|datum| datum.name() == name)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn problems(text: &str) -> Vec<String> {
        let raw: RawTerrain = toml::from_str(text).unwrap();
        let mut checks = Checks::new();
        raw.check(&mut checks);
        checks.into_problems()
    }

    #[test]
    fn a_plane_needs_a_height_and_tiles_need_paths() {
        let plane = "kind = \"plane\"\nsigma_m = 1.0\n";
        assert_eq!(
            problems(&format!("{plane}height_ellipsoid_m = 5.0")),
            [""; 0]
        );
        assert!(problems(plane)[0].contains("terrain.height_ellipsoid_m is missing"));
        let mixed = problems(&format!("{plane}height_ellipsoid_m = 5.0\ncanopy_m = 3.0"));
        assert_eq!(
            mixed,
            ["terrain.canopy_m is for kind \"tiles\", not for a plane"]
        );
        let tiles = "kind = \"tiles\"\nsigma_m = 4.0\n";
        assert_eq!(problems(&format!("{tiles}paths = [\"a.tif\"]")), [""; 0]);
        assert!(problems(tiles)[0].contains("terrain.paths is missing"));
    }

    #[test]
    fn every_problem_of_the_table_is_told() {
        let found = problems(
            "kind = \"tiles\"\nsigma_m = nan\npaths = [\"a\"]\nvertical_datum = \"msl\"\n\
             canopy_m = -1.0\nreach_m = 10.0\nheight_ellipsoid_m = 3.0",
        );
        assert_eq!(found.len(), 5, "{found:?}");
        assert!(problems("kind = \"hills\"\nsigma_m = 1.0")[0].contains("allowed are"));
    }

    #[test]
    fn tiles_that_are_refused_refuse_the_mission_each_in_a_sentence() {
        let raw: RawTerrain = toml::from_str(
            "kind = \"tiles\"\nsigma_m = 4.0\npaths = [\"nowhere.tif\", \"refused_utm.tif\"]\n\
             vertical_datum = \"egm96\"",
        )
        .unwrap();
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/terrain");
        let built = raw.build(&crate::testing::datum(), &|path| folder.join(path));
        let problems = built.map(|_| ()).unwrap_err();
        assert_eq!(problems.len(), 2, "{problems:?}");
        assert!(
            problems
                .iter()
                .all(|p| p.starts_with("terrain: ") && !p.contains('\n'))
        );
    }
}
