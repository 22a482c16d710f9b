//! The ground under the map: nothing by default; raster tiles from a folder or a server when the
//! configuration names one.

use std::path::{Path, PathBuf};

/// Background of the map.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::ground) struct MapConfig {
    source: Source,
    attribution: String,
    max_zoom: u8,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Source {
    /// `FOLDER/z/x/y.png`, served by this station.
    Folder(PathBuf),
    /// The browser asks there itself.
    Server { template: String, origin: String },
}

/// Most bytes of one tile that is served.
const MAX_TILE: u64 = 2 * 1024 * 1024;

impl MapConfig {
    /// `tiles` is a folder, or a template such as `https://tiles.example/{z}/{x}/{y}.png`.
    pub(super) fn new(
        tiles: &str,
        folder: &Path,
        attribution: String,
        max_zoom: u8,
    ) -> Result<Self, String> {
        let source = if tiles.contains("://") {
            server(tiles)?
        } else {
            Source::Folder(folder.join(tiles))
        };
        Ok(Self {
            source,
            attribution,
            max_zoom,
        })
    }

    /// What the page needs to know.
    pub(super) fn told(&self) -> serde_json::Value {
        let template = match &self.source {
            Source::Folder(_) => "/tiles/{z}/{x}/{y}.png",
            Source::Server { template, .. } => template,
        };
        serde_json::json!({
            "tiles": template, "attribution": self.attribution, "max_zoom": self.max_zoom,
        })
    }

    /// Where else the page may load pictures from.
    pub(in crate::ground) fn origin(&self) -> Option<&str> {
        match &self.source {
            Source::Folder(_) => None,
            Source::Server { origin, .. } => Some(origin),
        }
    }

    /// One tile from the folder. Numbers in, so no path can lead out of it.
    pub(super) fn tile(&self, zoom: u8, x: u32, y: u32) -> Option<Vec<u8>> {
        let Source::Folder(folder) = &self.source else {
            return None;
        };
        let path = folder.join(format!("{zoom}/{x}/{y}.png"));
        let size = std::fs::metadata(&path).ok()?.len();
        (size <= MAX_TILE).then(|| std::fs::read(path).ok())?
    }
}

/// The origin goes into a header that guards the page, so it must be one and nothing else.
fn server(template: &str) -> Result<Source, String> {
    let refused = || {
        format!(
            "map.tiles is {template:?}, allowed is a folder of z/x/y.png, or a template such as \
             https://tiles.example/{{z}}/{{x}}/{{y}}.png"
        )
    };
    let (scheme, rest) = template.split_once("://").ok_or_else(refused)?;
    let (host, path) = rest.split_once('/').ok_or_else(refused)?;
    let is_host = !host.is_empty()
        && host
            .chars()
            .all(|c| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | ':'));
    let has_all = ["{z}", "{x}", "{y}"].iter().all(|part| path.contains(part));
    if !matches!(scheme, "http" | "https") || !is_host || !has_all {
        return Err(refused());
    }
    Ok(Source::Server {
        template: template.to_owned(),
        origin: format!("{scheme}://{host}"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_plain_origin_gets_into_the_header() {
        let of = |tiles: &str| MapConfig::new(tiles, Path::new(""), String::new(), 19);
        let good = of("https://tiles.example:8443/{z}/{x}/{y}.png").unwrap();
        assert_eq!(good.origin(), Some("https://tiles.example:8443"));
        for bad in [
            "https://a;script-src *//{z}/{x}/{y}",
            "https://a b/{z}/{x}/{y}",
            "ftp://a/{z}/{x}/{y}",
            "https://a/{z}/{x}.png",
        ] {
            assert!(of(bad).is_err(), "{bad}");
        }
        assert_eq!(of("tiles").unwrap().origin(), None);
    }
}
