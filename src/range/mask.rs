//! Which pixels of a box look like flame.

/// A gate on hue, saturation and value, each 0..1.
///
/// Hue may wrap: a lower bound above the upper one means "through red". The gate is named, because
/// two are in use: [`HsvMask::printed`] and [`HsvMask::flame`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HsvMask {
    /// Hue, from and to; 0 is red, 1/6 yellow.
    pub hue: (f64, f64),
    /// Saturation, from and to.
    pub saturation: (f64, f64),
    /// Value, from and to.
    pub value: (f64, f64),
    /// Value from which a pixel counts whatever its hue: the white core of a flame.
    pub core_value: Option<f64>,
}

impl HsvMask {
    /// The thresholds that P3 prints. They drop saturated cores (V above 0.8) and red flame (hue
    /// below 25 degrees): checklist E8. Kept for comparison.
    #[must_use]
    pub fn printed() -> Self {
        Self {
            hue: (0.07, 0.20),
            saturation: (0.15, 0.8),
            value: (0.15, 0.8),
            core_value: None,
        }
    }

    /// Red through yellow, bright, with its overexposed core.
    #[must_use]
    pub fn flame() -> Self {
        Self {
            hue: (0.94, 0.20),
            saturation: (0.25, 1.0),
            value: (0.45, 1.0),
            core_value: Some(0.92),
        }
    }

    /// Whether one 8-bit BGR pixel passes.
    #[must_use]
    pub fn keeps(&self, bgr: [u8; 3]) -> bool {
        // Most of what is about a flame is too dark.
        let value = f64::from(bgr[0].max(bgr[1]).max(bgr[2])) / 255.0;
        if value < self.value.0 && self.core_value.is_none_or(|core| value < core) {
            return false;
        }
        let [blue, green, red] = bgr.map(|value| f64::from(value) / 255.0);
        self.keeps_hsv(hsv(red, green, blue))
    }

    fn keeps_hsv(&self, (hue, saturation, value): (f64, f64, f64)) -> bool {
        let within = |x: f64, (low, high): (f64, f64)| (low..=high).contains(&x);
        let hue_fits = if self.hue.0 <= self.hue.1 {
            within(hue, self.hue)
        } else {
            hue >= self.hue.0 || hue <= self.hue.1
        };
        let core = self.core_value.is_some_and(|core| value >= core);
        core || (hue_fits && within(saturation, self.saturation) && within(value, self.value))
    }
}

impl Default for HsvMask {
    fn default() -> Self {
        Self::flame()
    }
}

#[inline]
fn hsv(red: f64, green: f64, blue: f64) -> (f64, f64, f64) {
    let value = red.max(green).max(blue);
    let spread = value - red.min(green).min(blue);
    if spread <= 0.0 {
        return (0.0, 0.0, value);
    }
    let sixths = if value == red {
        (green - blue) / spread
    } else if value == green {
        2.0 + (blue - red) / spread
    } else {
        4.0 + (red - green) / spread
    };
    ((sixths / 6.0).rem_euclid(1.0), spread / value, value)
}

#[cfg(test)]
mod tests {
    use super::*;

    const ORANGE: [u8; 3] = [40, 120, 200];
    const WHITE_CORE: [u8; 3] = [225, 250, 255];
    const RED_FLAME: [u8; 3] = [30, 50, 230];

    #[test]
    fn the_printed_gate_drops_cores_and_red_flame_and_ours_keeps_them() {
        let (printed, ours) = (HsvMask::printed(), HsvMask::flame());
        assert!(printed.keeps(ORANGE) && ours.keeps(ORANGE));
        for flame in [WHITE_CORE, RED_FLAME] {
            assert!(!printed.keeps(flame), "{flame:?}");
            assert!(ours.keeps(flame), "{flame:?}");
        }
    }

    #[test]
    fn grass_sky_and_asphalt_are_no_flame() {
        for other in [[40, 120, 60], [220, 170, 110], [70, 70, 70], [30, 30, 30]] {
            assert!(!HsvMask::flame().keeps(other), "{other:?}");
        }
    }
}
