//! Tileable textures with mip levels: what gives stereo matching something to hold on to.

use super::config::GroundCover;
use rayon::prelude::*;

/// Linear red, green, blue and one spare lane that keeps the arithmetic four wide.
pub(crate) type Rgb = [f32; 4];

/// A square, tileable texture and its halvings down to one texel.
#[derive(Debug, Clone)]
pub(crate) struct Texture {
    levels: Vec<Level>,
    texels_per_m: f32,
}

#[derive(Debug, Clone)]
struct Level {
    /// Side minus one; the side is a power of two.
    mask: i32,
    shift: u32,
    texels: Vec<[u8; 4]>,
}

/// Texel value that stands for a factor of one.
pub(crate) const UNIT: f32 = 1.0 / 128.0;

/// One or two neighbouring mip levels, chosen once for a block of pixels.
#[derive(Clone, Copy)]
pub(crate) struct Lod<'a> {
    fine: &'a Level,
    coarse: Option<(&'a Level, f32)>,
    fine_texels_per_m: f32,
    /// Where the fine level's texel zero has its centre, in its own texels.
    fine_origin: f32,
}

impl Texture {
    fn new(side: usize, tile_m: f32, texels: Vec<[u8; 4]>) -> Self {
        let mut levels = vec![Level::new(side, texels)];
        while let Some(last) = levels.last().filter(|level| level.mask > 0) {
            let half = last.halved();
            levels.push(half);
        }
        Self {
            levels,
            texels_per_m: side as f32 / tile_m,
        }
    }

    /// Levels for a footprint of one pixel on the ground, metres. The finest detail that a pixel
    /// can still hold is kept; finer would alias and crawl.
    pub(crate) fn lod(&self, footprint_m: f32) -> Lod<'_> {
        let last = self.levels.len() - 1;
        let wanted = (footprint_m * self.texels_per_m)
            .max(1e-6)
            .log2()
            .clamp(0.0, last as f32);
        let (fine, fraction) = (wanted as usize, wanted.fract());
        // The middle of the way is where the blend is seen; beside it one level is enough.
        let weight = ((fraction - 0.4) / 0.2).clamp(0.0, 1.0);
        let fine = if weight >= 1.0 {
            (fine + 1).min(last)
        } else {
            fine
        };
        let coarse =
            (weight > 0.0 && weight < 1.0 && fine < last).then(|| (&self.levels[fine + 1], weight));
        let halvings = (1 << fine) as f32;
        Lod {
            fine: &self.levels[fine],
            coarse,
            fine_texels_per_m: self.texels_per_m / halvings,
            fine_origin: 0.5 - 0.5 / halvings,
        }
    }

    /// Whether a pixel of this footprint sees nothing but the texture's mean.
    pub(crate) fn is_flat_at(&self, footprint_m: f32) -> bool {
        footprint_m * self.texels_per_m > 64.0
    }

    /// A place within the tile, metres: what single precision can add to.
    pub(crate) fn origin(&self, (east_m, north_m): (f64, f64)) -> (f32, f32) {
        let tile = f64::from(self.levels[0].mask + 1) / f64::from(self.texels_per_m);
        (
            east_m.rem_euclid(tile) as f32,
            north_m.rem_euclid(tile) as f32,
        )
    }
}

impl Lod<'_> {
    /// Colour at a place in metres, 0 to 255 a channel.
    pub(crate) fn at(&self, x_m: f32, y_m: f32) -> Rgb {
        let x = x_m * self.fine_texels_per_m - self.fine_origin;
        let y = y_m * self.fine_texels_per_m - self.fine_origin;
        let fine = self.fine.bilinear(x, y);
        match self.coarse {
            None => fine,
            // A halved texel's centre lies between its two.
            Some((level, weight)) => {
                mix(fine, level.bilinear(x * 0.5 - 0.25, y * 0.5 - 0.25), weight)
            }
        }
    }
}

impl Level {
    fn new(side: usize, texels: Vec<[u8; 4]>) -> Self {
        Self {
            mask: side as i32 - 1,
            shift: side.trailing_zeros(),
            texels,
        }
    }

    fn halved(&self) -> Self {
        let side = (self.mask as usize).div_ceil(2);
        let texel = |i: usize| {
            let (x, y) = (2 * (i % side) as i32, 2 * (i / side) as i32);
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| self.texel(x + dx, y + dy));
            std::array::from_fn(|c| (four.iter().map(|t| u32::from(t[c])).sum::<u32>() / 4) as u8)
        };
        Self::new(side, (0..side * side).map(texel).collect())
    }

    #[inline]
    fn texel(&self, x: i32, y: i32) -> [u8; 4] {
        self.texels[(((y & self.mask) << self.shift) | (x & self.mask)) as usize]
    }

    #[inline]
    fn bilinear(&self, x: f32, y: f32) -> Rgb {
        let (ix, iy) = (floor(x), floor(y));
        let (fx, fy) = (x - ix as f32, y - iy as f32);
        let top = mix(lanes(self.texel(ix, iy)), lanes(self.texel(ix + 1, iy)), fx);
        let bottom = mix(
            lanes(self.texel(ix, iy + 1)),
            lanes(self.texel(ix + 1, iy + 1)),
            fx,
        );
        mix(top, bottom, fy)
    }
}

#[inline]
fn lanes(texel: [u8; 4]) -> Rgb {
    texel.map(f32::from)
}

/// `f32::floor` is a library call on the plainest x86-64; this is not.
#[inline]
fn floor(x: f32) -> i32 {
    let toward_zero = x as i32;
    toward_zero - i32::from((toward_zero as f32) > x)
}

#[inline]
pub(crate) fn mix(a: Rgb, b: Rgb, weight: f32) -> Rgb {
    std::array::from_fn(|c| a[c] + (b[c] - a[c]) * weight)
}

/// The textures of one world.
#[derive(Debug, Clone)]
pub(crate) struct Textures {
    /// Blades, crumbs and pebbles: a factor, millimetres to a decimetre.
    pub fine: Texture,
    /// Tufts and clods: a factor, centimetres to metres.
    pub middle: Texture,
    /// What covers the ground: albedo, decimetres to a hundred metres.
    pub cover: Texture,
    /// Leaves: a factor.
    pub leaves: Texture,
    /// Soft billows for flames and smoke; its tile is one metre of splat-local space.
    pub billows: Texture,
}

impl Textures {
    pub(crate) fn new(covers: &[GroundCover], seed: u64) -> Self {
        Self {
            fine: factor(FINE, 1.0, seed ^ 0x11),
            middle: factor(MIDDLE, 0.8, seed ^ 0x22),
            cover: cover(covers, seed ^ 0x33),
            leaves: factor(LEAVES, 1.5, seed ^ 0x44),
            billows: factor(BILLOWS, 1.0, seed ^ 0x55),
        }
    }
}

/// How a noise texture is made.
#[derive(Clone, Copy)]
struct Recipe {
    side: usize,
    tile_m: f32,
    /// Lattice cells along the tile in the coarsest octave.
    cells: u32,
    octaves: u32,
    /// Amplitude of each octave against the coarser one.
    persistence: f32,
    /// Standard deviation of the factor.
    contrast: f32,
}

const FINE: Recipe = Recipe {
    side: 512,
    tile_m: 3.1,
    cells: 24,
    octaves: 4,
    persistence: 0.85,
    contrast: 0.22,
};
const MIDDLE: Recipe = Recipe {
    side: 512,
    tile_m: 23.7,
    cells: 10,
    octaves: 6,
    persistence: 0.8,
    contrast: 0.24,
};
const LEAVES: Recipe = Recipe {
    side: 256,
    tile_m: 3.3,
    cells: 12,
    octaves: 4,
    persistence: 0.9,
    contrast: 0.42,
};
const BILLOWS: Recipe = Recipe {
    side: 128,
    tile_m: 1.0,
    cells: 3,
    octaves: 4,
    persistence: 0.6,
    contrast: 0.35,
};
const COVER_SIDE: usize = 512;
const COVER_TILE_M: f32 = 191.0;

/// A texture of factors about one, faintly coloured.
fn factor(recipe: Recipe, tint: f32, seed: u64) -> Texture {
    let light = fractal(recipe, seed);
    let hue = fractal(recipe, seed ^ 0xA5A5);
    let texels = light.iter().zip(&hue).map(|(l, h)| {
        let level = 1.0 + recipe.contrast * l;
        let shift = 0.06 * tint * h;
        [level * (1.0 + shift), level, level * (1.0 - shift), level].map(to_texel)
    });
    Texture::new(recipe.side, recipe.tile_m, texels.collect())
}

fn to_texel(factor: f32) -> u8 {
    (factor / UNIT).clamp(0.0, 255.0) as u8
}

/// Albedo of the ground in patches of the covers.
fn cover(covers: &[GroundCover], seed: u64) -> Texture {
    let patch = Recipe {
        side: COVER_SIDE,
        tile_m: COVER_TILE_M,
        cells: 4,
        octaves: 6,
        persistence: 0.55,
        contrast: 1.0,
    };
    let fields: Vec<Vec<f32>> = (0..covers.len() as u64)
        .map(|k| fractal(patch, seed ^ (k + 1) << 8))
        .collect();
    let speckle = fractal(
        Recipe {
            cells: 48,
            octaves: 4,
            persistence: 0.8,
            ..patch
        },
        seed ^ 7,
    );
    let texels = (0..COVER_SIDE * COVER_SIDE).map(|i| {
        let weights: Vec<f32> = fields.iter().map(|field| (4.0 * field[i]).exp()).collect();
        let total: f32 = weights.iter().sum();
        let mut albedo = [0.0; 4];
        for (weight, cover) in weights.iter().zip(covers) {
            albedo = mix_in(albedo, albedo_of(*cover), weight / total);
        }
        albedo.map(|a| (255.0 * a * (1.0 + 0.16 * speckle[i])).clamp(0.0, 255.0) as u8)
    });
    Texture::new(COVER_SIDE, COVER_TILE_M, texels.collect())
}

fn mix_in(sum: Rgb, colour: Rgb, weight: f32) -> Rgb {
    std::array::from_fn(|c| sum[c] + colour[c] * weight)
}

/// Linear albedo, red, green, blue and their mean.
fn albedo_of(cover: GroundCover) -> Rgb {
    let [r, g, b] = match cover {
        GroundCover::Grass => [0.085, 0.135, 0.035],
        GroundCover::Straw => [0.33, 0.26, 0.12],
        GroundCover::Soil => [0.20, 0.145, 0.095],
        GroundCover::RedSoil => [0.30, 0.135, 0.07],
        GroundCover::Rock => [0.27, 0.26, 0.24],
        GroundCover::ForestFloor => [0.075, 0.07, 0.04],
        GroundCover::Asphalt => [0.09, 0.09, 0.092],
        GroundCover::Snow => [0.68, 0.70, 0.73],
    };
    [r, g, b, (r + g + b) / 3.0]
}

/// Tileable gradient noise summed over octaves, mean 0 and standard deviation 1, clipped at 3.
fn fractal(recipe: Recipe, seed: u64) -> Vec<f32> {
    let side = recipe.side;
    let mut field: Vec<f32> = (0..side)
        .into_par_iter()
        .flat_map_iter(|y| (0..side).map(move |x| octaves(recipe, seed, x, y)))
        .collect();
    let n = field.len() as f32;
    let mean = field.iter().sum::<f32>() / n;
    let sigma = (field.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n)
        .sqrt()
        .max(1e-6);
    for value in &mut field {
        *value = ((*value - mean) / sigma).clamp(-3.0, 3.0);
    }
    field
}

fn octaves(recipe: Recipe, seed: u64, x: usize, y: usize) -> f32 {
    let (mut sum, mut amplitude, mut cells) = (0.0, 1.0, recipe.cells);
    for octave in 0..recipe.octaves {
        let scale = cells as f32 / recipe.side as f32;
        let at = ((x as f32 + 0.5) * scale, (y as f32 + 0.5) * scale);
        sum += amplitude * gradient_noise(at, cells, seed.wrapping_add(u64::from(octave)));
        amplitude *= recipe.persistence;
        cells *= 2;
    }
    sum
}

/// Perlin's gradient noise on a lattice that repeats after `cells`.
fn gradient_noise((x, y): (f32, f32), cells: u32, seed: u64) -> f32 {
    let (ix, iy) = (x as u32, y as u32);
    let (fx, fy) = (x.fract(), y.fract());
    let corner = |dx: u32, dy: u32| {
        let h = hash(seed, (ix + dx) % cells, (iy + dy) % cells);
        let (sin, cos) = DIRECTIONS[(h >> 13) as usize % DIRECTIONS.len()];
        cos * (fx - dx as f32) + sin * (fy - dy as f32)
    };
    let (sx, sy) = (fade(fx), fade(fy));
    let top = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * sx;
    let bottom = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * sx;
    top + (bottom - top) * sy
}

/// Twelve directions, sine and cosine: enough that no axis is preferred.
const DIRECTIONS: [(f32, f32); 12] = [
    (0.0, 1.0),
    (0.5, 0.866_025_4),
    (0.866_025_4, 0.5),
    (1.0, 0.0),
    (0.866_025_4, -0.5),
    (0.5, -0.866_025_4),
    (0.0, -1.0),
    (-0.5, -0.866_025_4),
    (-0.866_025_4, -0.5),
    (-1.0, 0.0),
    (-0.866_025_4, 0.5),
    (-0.5, 0.866_025_4),
];

fn fade(t: f32) -> f32 {
    t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
}

/// Mixes a seed and two numbers into 64 random bits (the finaliser of SplitMix64).
pub(crate) fn hash(seed: u64, a: u32, b: u32) -> u64 {
    let mut z = seed ^ (u64::from(a) << 32 | u64::from(b)).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn textures_repeat_without_a_seam() {
        let texture = factor(LEAVES, 1.0, 9);
        let lod = texture.lod(0.001);
        for k in 0..50 {
            let (x, y) = (0.07 * k as f32, 0.11 * k as f32);
            let (here, there) = (lod.at(x, y), lod.at(x + LEAVES.tile_m, y - LEAVES.tile_m));
            assert!(
                here.iter().zip(there).all(|(a, b)| (a - b).abs() < 0.1),
                "{here:?} {there:?}"
            );
        }
    }

    /// Otherwise a point would move in the picture as the camera comes nearer.
    #[test]
    fn coarser_levels_keep_the_mean_and_the_place() {
        let texture = factor(MIDDLE, 1.0, 4);
        let (sharp, soft) = (texture.lod(0.045), texture.lod(8.0 * 23.7 / 512.0));
        let mean_around = |x: f32, y: f32| {
            let offset = |i: i32| (i as f32 - 3.5) * 23.7 / 512.0;
            let square = (0..64).map(|i| sharp.at(x + offset(i % 8), y + offset(i / 8))[1]);
            square.sum::<f32>() / 64.0
        };
        for k in 0..64 {
            // Centres of the coarse texels, where it holds the mean of 8 by 8 fine ones.
            let centre = |i: i32| (i as f32 * 8.0 + 3.5) * 23.7 / 512.0;
            let (x, y) = (centre(k % 8), centre(3 * k / 8));
            assert!(
                (mean_around(x, y) - soft.at(x, y)[1]).abs() < 3.0,
                "texel {k}"
            );
        }
    }
}
