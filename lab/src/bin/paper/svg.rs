//! Line plots as SVG: axes with ticks, a legend, one polyline per curve.

use std::fmt::Write as _;

const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 480.0;
const LEFT: f64 = 70.0;
const RIGHT: f64 = 20.0;
const TOP: f64 = 56.0;
const BOTTOM: f64 = 55.0;
/// Width of one entry of the legend.
const ENTRY: f64 = 220.0;
/// Colours that differ for colour-blind readers too.
const COLOURS: [&str; 4] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7"];

/// One line of a plot.
pub(crate) struct Curve<'a> {
    pub(crate) name: &'a str,
    pub(crate) points: Vec<[f64; 2]>,
}

/// One plot.
pub(crate) struct Plot<'a> {
    pub(crate) title: &'a str,
    pub(crate) x_label: &'a str,
    pub(crate) y_label: &'a str,
    /// The same scale on both axes, for maps.
    pub(crate) equal_scale: bool,
    pub(crate) curves: Vec<Curve<'a>>,
}

/// From figures to picture units.
struct Frame {
    low: [f64; 2],
    high: [f64; 2],
}

impl Frame {
    fn around(plot: &Plot) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for point in plot.curves.iter().flat_map(|curve| &curve.points) {
            for axis in 0..2 {
                low[axis] = low[axis].min(point[axis]);
                high[axis] = high[axis].max(point[axis]);
            }
        }
        for axis in 0..2 {
            let margin = 0.04 * (high[axis] - low[axis]).max(1.0e-9);
            low[axis] -= margin;
            high[axis] += margin;
        }
        let mut frame = Self { low, high };
        if plot.equal_scale {
            let room = [WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM];
            let scale = (0..2)
                .map(|axis| (frame.high[axis] - frame.low[axis]) / room[axis])
                .fold(0.0, f64::max);
            for (axis, room) in room.into_iter().enumerate() {
                let middle = 0.5 * (frame.high[axis] + frame.low[axis]);
                frame.low[axis] = middle - 0.5 * scale * room;
                frame.high[axis] = middle + 0.5 * scale * room;
            }
        }
        frame
    }

    fn x(&self, value: f64) -> f64 {
        LEFT + (value - self.low[0]) / (self.high[0] - self.low[0]) * (WIDTH - LEFT - RIGHT)
    }

    fn y(&self, value: f64) -> f64 {
        let share = (value - self.low[1]) / (self.high[1] - self.low[1]);
        HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM)
    }

    /// Round figures along an axis: steps of 1, 2 or 5 times a power of ten.
    fn ticks(&self, axis: usize) -> Vec<f64> {
        let span = self.high[axis] - self.low[axis];
        let rough = span / 8.0;
        let power = 10.0_f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0]
            .map(|factor| factor * power)
            .into_iter()
            .find(|step| *step >= rough)
            .unwrap_or(rough);
        let first = (self.low[axis] / step).ceil();
        (0..12)
            .map(|index| (first + f64::from(index)) * step)
            .take_while(|tick| *tick <= self.high[axis])
            .collect()
    }
}

/// A figure without needless zeros.
fn label(value: f64) -> String {
    let text = format!("{value:.4}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" {
        "0".to_owned()
    } else {
        text.to_owned()
    }
}

/// The plot as an SVG document.
pub(crate) fn render(plot: &Plot) -> String {
    let frame = Frame::around(plot);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" \
         font-family=\"sans-serif\" font-size=\"12\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n\
         <text x=\"{}\" y=\"22\" text-anchor=\"middle\" font-size=\"15\">{}</text>\n",
        0.5 * WIDTH,
        plot.title
    );
    let (low_x, high_x, low_y, high_y) = (LEFT, WIDTH - RIGHT, HEIGHT - BOTTOM, TOP);
    for tick in frame.ticks(0) {
        let x = frame.x(tick);
        let _ = writeln!(
            svg,
            "<path d=\"M{x:.1} {high_y}V{low_y}\" stroke=\"#ddd\"/>\
             <text x=\"{x:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
            low_y + 16.0,
            label(tick)
        );
    }
    for tick in frame.ticks(1) {
        let y = frame.y(tick);
        let _ = writeln!(
            svg,
            "<path d=\"M{low_x} {y:.1}H{high_x}\" stroke=\"#ddd\"/>\
             <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            low_x - 6.0,
            y + 4.0,
            label(tick)
        );
    }
    let _ = writeln!(
        svg,
        "<path d=\"M{low_x} {high_y}V{low_y}H{high_x}\" fill=\"none\" stroke=\"black\"/>\
         <text x=\"{}\" y=\"{}\" text-anchor=\"middle\">{}</text>\
         <text transform=\"translate(16 {}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
        0.5 * (low_x + high_x),
        HEIGHT - 14.0,
        plot.x_label,
        0.5 * (low_y + high_y),
        plot.y_label
    );
    for (index, curve) in plot.curves.iter().enumerate() {
        let colour = COLOURS[index % COLOURS.len()];
        // The first curve is the wider one: it shows where the others cover it.
        let width = if index == 0 { 3.2 } else { 1.4 };
        let _ = write!(
            svg,
            "<polyline fill=\"none\" stroke-width=\"{width}\" stroke=\"{colour}\" points=\""
        );
        for [x, y] in &curve.points {
            let _ = write!(svg, "{:.1},{:.1} ", frame.x(*x), frame.y(*y));
        }
        let left = LEFT + ENTRY * f64::from(u32::try_from(index).unwrap_or(0));
        let _ = writeln!(
            svg,
            "\"/>\n<path d=\"M{left} 40h24\" stroke-width=\"{width}\" stroke=\"{colour}\"/>\
             <text x=\"{}\" y=\"44\">{}</text>",
            left + 30.0,
            curve.name
        );
    }
    svg.push_str("</svg>\n");
    svg
}
