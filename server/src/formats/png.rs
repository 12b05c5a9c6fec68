//! Draws the map as a PNG image with a legend: θ as colour, hatched where uncertain, transparent
//! where unknown. The site's y axis points up.

use std::collections::BTreeMap;
use std::convert::Infallible;

use embedded_graphics::draw_target::DrawTarget;
use embedded_graphics::geometry::{OriginDimensions, Point, Size};
use embedded_graphics::mono_font::iso_8859_7::FONT_7X13;
use embedded_graphics::mono_font::{MonoFont, MonoTextStyle};
use embedded_graphics::pixelcolor::{Rgb888, RgbColor as _};
use embedded_graphics::text::{Baseline, Text};
use embedded_graphics::{Drawable as _, Pixel};

use super::palette::{HATCHED, Rgb, THETA_HIGH, THETA_LOW, cividis, density, share};
use crate::friction::Raster;
use crate::friction::index::KnownCell;

/// Media type of the image.
pub const MEDIA_TYPE: &str = "image/png";
/// Minimum length of the longer side in pixels if the request gives no scale.
const SIDE_PX: usize = 768;
/// Maximum side of a map square, in pixels.
pub const SCALE_MAX: usize = 32;
/// Maximum number of pixels of the map without its legend; a larger image is refused.
const PIXELS_MAX: usize = 1 << 24;
/// Minimum side of a map square that is hatched, in pixels; smaller ones are not.
const HATCHED_SIDE_PX: usize = 4;
/// Distance between hatching lines of each density, in pixels.
const LINES_PX: [usize; 3] = [11, 7, 4];
/// Relative standard deviation at the right end of the legend.
const LEGEND_END: f64 = 0.75;
/// Font of the legend, with Greek letters.
const FONT: MonoFont<'_> = FONT_7X13;
/// Width and height of a letter, in pixels.
const LETTER_PX: (usize, usize) = (
    FONT.character_size.width as usize,
    FONT.character_size.height as usize,
);
/// Margin in the legend, in pixels.
const MARGIN_PX: usize = 8;
/// Height of a colour bar in the legend, in pixels.
const BAR_PX: usize = 12;
/// Minimum width of the legend, in pixels.
const LEGEND_WIDTH_PX: usize = 280;
const WHITE: Rgb = [255; 3];
const INK: Rgb = [32; 3];
/// Values of θ labelled in the legend.
const TICKS: [&str; 6] = ["0.05", "0.1", "0.2", "0.5", "1", "2"];

/// Error of drawing the map.
#[derive(Debug, thiserror::Error)]
pub enum PngError {
    /// The image would exceed the maximum size; the value is the requested side of a square in
    /// pixels.
    #[error("with {0} pixels to a square this would be more than {PIXELS_MAX} pixels")]
    TooLarge(usize),
    /// The image cannot be encoded.
    #[error("the picture cannot be written")]
    Encode(#[from] ::png::EncodingError),
}

/// Rectangle of an image, in pixels.
#[derive(Debug, Clone, Copy)]
struct Rectangle {
    x: usize,
    y: usize,
    width: usize,
    height: usize,
}

/// Position in an image, in pixels.
#[derive(Debug, Clone, Copy)]
struct Position {
    x: usize,
    y: usize,
}

/// RGBA image, initially transparent.
struct Canvas {
    width: usize,
    height: usize,
    pixels: Vec<u8>,
}

impl Canvas {
    fn put(&mut self, Position { x, y }: Position, [red, green, blue]: Rgb) {
        if x < self.width && y < self.height {
            let at = 4 * (y * self.width + x);
            self.pixels[at..at + 4].copy_from_slice(&[red, green, blue, 255]);
        }
    }

    fn fill(&mut self, within: Rectangle, ink: Rgb) {
        for y in within.y..within.y + within.height {
            for x in within.x..within.x + within.width {
                self.put(Position { x, y }, ink);
            }
        }
    }

    fn write(&mut self, Position { x, y }: Position, text: &str) {
        let [red, green, blue] = INK;
        let style = MonoTextStyle::new(&FONT, Rgb888::new(red, green, blue));
        let place = |pixels: usize| i32::try_from(pixels).unwrap_or(i32::MAX);
        let at = Point::new(place(x), place(y));
        let Ok(_end) = Text::with_baseline(text, at, style, Baseline::Top).draw(self);
    }
}

impl OriginDimensions for Canvas {
    fn size(&self) -> Size {
        let side = |pixels: usize| u32::try_from(pixels).unwrap_or(u32::MAX);
        Size::new(side(self.width), side(self.height))
    }
}

impl DrawTarget for Canvas {
    type Color = Rgb888;
    type Error = Infallible;

    fn draw_iter<I: IntoIterator<Item = Pixel<Rgb888>>>(
        &mut self,
        pixels: I,
    ) -> Result<(), Infallible> {
        for Pixel(at, ink) in pixels {
            if let (Ok(x), Ok(y)) = (usize::try_from(at.x), usize::try_from(at.y)) {
                self.put(Position { x, y }, [ink.r(), ink.g(), ink.b()]);
            }
        }
        Ok(())
    }
}

fn text_width_px(text: &str) -> usize {
    text.chars().count() * LETTER_PX.0
}

/// Returns the side of a map square in pixels if the request gives none.
fn scale_of(raster: &Raster) -> usize {
    let side = raster.columns.max(raster.rows).max(1);
    SIDE_PX.div_ceil(side).clamp(1, SCALE_MAX)
}

/// Draws the map as a PNG file, with map squares of `scale` pixels, clamped to 1 to [`SCALE_MAX`].
///
/// # Errors
/// [`PngError::TooLarge`] if the image would be too large.
pub fn encode(raster: &Raster, scale: Option<usize>) -> Result<Vec<u8>, PngError> {
    let scale = scale
        .unwrap_or_else(|| scale_of(raster))
        .clamp(1, SCALE_MAX);
    let (width, height) = (raster.columns * scale, raster.rows * scale);
    if width.saturating_mul(height) > PIXELS_MAX {
        return Err(PngError::TooLarge(scale));
    }
    let (_, letters) = LETTER_PX;
    let legend = 5 * MARGIN_PX + 2 * (BAR_PX + letters + 2);
    let mut canvas = Canvas {
        width: width.max(LEGEND_WIDTH_PX),
        height: height + legend,
        pixels: Vec::new(),
    };
    canvas.pixels = vec![0; 4 * canvas.width * canvas.height];
    for (row, squares) in raster.rows().rev().enumerate() {
        for (column, square) in squares.iter().enumerate() {
            if let Some(known) = square.known() {
                let (x, y) = (column * scale, row * scale);
                draw(&mut canvas, Position { x, y }, scale, &known);
            }
        }
    }
    draw_legend(&mut canvas, height);
    write(&canvas, raster)
}

fn draw(canvas: &mut Canvas, corner: Position, scale: usize, known: &KnownCell) {
    let density = if scale < HATCHED_SIDE_PX {
        0
    } else {
        density(known.std_dev / known.theta)
    };
    let ink = cividis(share(known.theta));
    for y in corner.y..corner.y + scale {
        for x in corner.x..corner.x + scale {
            let at = Position { x, y };
            canvas.put(at, hatched(at, density, ink));
        }
    }
}

/// Returns the colour of a pixel: diagonal lines, light with a dark edge, are visible on every colour
/// of the scale.
fn hatched(at: Position, density: usize, ink: Rgb) -> Rgb {
    let Some(distance) = density.checked_sub(1).map(|index| LINES_PX[index]) else {
        return ink;
    };
    match (at.x + at.y) % distance {
        0 => WHITE,
        1 => ink.map(|channel| channel / 2),
        _ => ink,
    }
}

/// Draws a tick below a colour bar.
fn draw_tick(canvas: &mut Canvas, Position { x, y }: Position, text: &str) {
    let tick = Rectangle {
        x,
        y,
        width: 1,
        height: 3,
    };
    canvas.fill(tick, INK);
    let width_px = text_width_px(text);
    let left = x
        .saturating_sub(width_px / 2)
        .min(canvas.width - width_px - 1);
    canvas.write(Position { x: left, y: y + 4 }, text);
}

/// Draws a colour bar for θ and a hatched one for the relative standard deviation, from a row down to the
/// end of the image.
#[expect(
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "pixels"
)]
fn draw_legend(canvas: &mut Canvas, top: usize) {
    let (_, letters) = LETTER_PX;
    let width = canvas.width;
    let whole = Rectangle {
        x: 0,
        y: top,
        width,
        height: canvas.height - top,
    };
    canvas.fill(whole, WHITE);
    let title = text_width_px("θ") + MARGIN_PX;
    let left = MARGIN_PX + title.max(text_width_px("σ/θ") + MARGIN_PX);
    let bar = width - left - 2 * MARGIN_PX;
    let at = |share: f64| left + (share * bar as f64).round() as usize;
    let mut y = top + MARGIN_PX;
    canvas.write(Position { x: MARGIN_PX, y }, "θ");
    for column in 0..bar {
        let ink = cividis(column as f64 / bar as f64);
        let line = Rectangle {
            x: left + column,
            y,
            width: 1,
            height: BAR_PX,
        };
        canvas.fill(line, ink);
    }
    y += BAR_PX;
    for tick in TICKS {
        let value = tick.parse().unwrap_or(THETA_LOW);
        let x = at((value / THETA_LOW).ln() / (THETA_HIGH / THETA_LOW).ln());
        draw_tick(canvas, Position { x, y }, tick);
    }
    y += letters + 2 + 2 * MARGIN_PX;
    canvas.write(Position { x: MARGIN_PX, y }, "σ/θ");
    for column in 0..bar {
        let density = density(column as f64 / bar as f64 * LEGEND_END);
        let x = left + column;
        for y in y..y + BAR_PX {
            let at = Position { x, y };
            canvas.put(at, hatched(at, density, cividis(0.5)));
        }
    }
    y += BAR_PX;
    for least in HATCHED {
        let tick = &format!("{:.0}%", 100.0 * least);
        let x = at(least / LEGEND_END);
        draw_tick(canvas, Position { x, y }, tick);
    }
}

fn write(canvas: &Canvas, raster: &Raster) -> Result<Vec<u8>, PngError> {
    let side = |pixels: usize| u32::try_from(pixels).unwrap_or(u32::MAX);
    let mut bytes = Vec::new();
    let mut encoder = ::png::Encoder::new(&mut bytes, side(canvas.width), side(canvas.height));
    encoder.set_color(::png::ColorType::Rgba);
    encoder.set_depth(::png::BitDepth::Eight);
    encoder.set_compression(::png::Compression::Fast);
    for (keyword, text) in texts(raster) {
        encoder.add_itxt_chunk(keyword.to_owned(), text)?;
    }
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&canvas.pixels)?;
    writer.finish()?;
    Ok(bytes)
}

/// Returns the text chunks of the file: site, model, geometry and configuration of the map.
fn texts(raster: &Raster) -> BTreeMap<&'static str, String> {
    let corner = raster.corner();
    let mut texts = BTreeMap::from([
        ("tread:site", raster.site.id.to_string()),
        ("tread:model", raster.model.clone()),
        ("tread:first", format!("{} {}", corner.x_m, corner.y_m)),
        ("tread:size_m", raster.size_m.to_string()),
        ("tread:columns", raster.columns.to_string()),
        ("tread:rows", raster.rows.to_string()),
    ]);
    if let Some(configuration) = raster.configuration {
        texts.insert("tread:configuration", configuration.to_string());
    }
    if let Some(normalisation) = &raster.normalisation {
        texts.insert("tread:normalisation", normalisation.clone());
    }
    texts
}
