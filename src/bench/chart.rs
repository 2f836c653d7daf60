//! Charts, worked out to the pixel; the report's template draws them as SVG.

use std::f64::consts::TAU;

use serde::Serialize;

/// Colours that stay apart for the colour-blind (Okabe and Ito 2008, "Color Universal Design"), without the yellow that is
/// too light for lines.
pub const COLORS: [&str; 7] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000"];

/// Shapes of markers, for those who tell no colours.
const SHAPES: [Shape; 5] = [
    Shape { corners: 0, turn: 0.0 },
    Shape { corners: 4, turn: 0.125 },
    Shape { corners: 3, turn: 0.75 },
    Shape { corners: 4, turn: 0.0 },
    Shape { corners: 3, turn: 0.25 },
];

/// Size of a chart, pixels; the legend's column is its right part.
const SIZE: [f64; 2] = [740.0, 400.0];
/// The plot itself: left, top, right, bottom.
const PLOT: [f64; 4] = [66.0, 46.0, 490.0, 350.0];
/// Radius of a marker, pixels.
const MARKER: f64 = 4.5;
/// Height of a legend's line, pixels.
const LINE: f64 = 18.0;

/// A regular polygon; without corners a circle.
struct Shape {
    corners: u32,
    /// Of the first corner from the right, in turns, downwards.
    turn: f64,
}

/// A point to draw.
#[derive(Debug, Clone)]
pub struct Mark {
    /// In the axes' units.
    pub at: [f64; 2],
    /// Shown when it is pointed at.
    pub title: String,
    /// Written beside it.
    pub number: String,
    /// Drawn as an outline.
    pub hollow: bool,
}

/// Points of one kind.
#[derive(Debug, Clone)]
pub struct Series {
    /// For the legend.
    pub name: String,
    /// Points.
    pub marks: Vec<Mark>,
    /// Points that a line goes through, in the axes' units.
    pub line: Vec<[f64; 2]>,
}

/// How values are laid out along an axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// By their logarithms; all are above 0.
    Log,
    /// Evenly.
    Linear,
}

/// What an axis shows.
#[derive(Debug, Clone, Copy)]
pub struct Labels<'a> {
    /// Below.
    pub x: &'a str,
    /// How the lower axis is laid out; the others are logarithmic.
    pub x_scale: Scale,
    /// Beside.
    pub y: &'a str,
    /// Above, with what a value below is divided by.
    pub top: Option<(&'a str, f64)>,
}

/// A chart, ready to be drawn; all lengths in pixels.
#[derive(Debug, Serialize)]
pub struct Chart {
    size: [f64; 2],
    plot: [f64; 4],
    x_label: String,
    y_label: String,
    top_label: Option<String>,
    x_ticks: Vec<Tick>,
    y_ticks: Vec<Tick>,
    top_ticks: Vec<Tick>,
    series: Vec<Drawn>,
}

#[derive(Debug, Serialize)]
struct Tick {
    at: f64,
    label: String,
}

#[derive(Debug, Serialize)]
struct Drawn {
    name: String,
    color: &'static str,
    line: String,
    marks: Vec<DrawnMark>,
    legend: DrawnMark,
}

#[derive(Debug, Serialize)]
struct DrawnMark {
    path: String,
    at: [f64; 2],
    title: String,
    number: String,
    hollow: bool,
}

impl Chart {
    /// A chart of some series; none where there is no point.
    pub fn new(series: &[Series], labels: Labels) -> Option<Self> {
        let all = || series.iter().flat_map(|series| &series.marks).map(|mark| mark.at);
        let [left, top, right, bottom] = PLOT;
        let x = Axis::over(all().map(|at| at[0]), [left, right], labels.x_scale)?;
        let y = Axis::over(all().map(|at| at[1]), [bottom, top], Scale::Log)?;
        let place = |at: [f64; 2]| [x.place(at[0]), y.place(at[1])].map(rounded);
        let drawn = series.iter().enumerate().map(|(i, series)| {
            let draw = |mark: &Mark| DrawnMark::new(i, place(mark.at), mark);
            let line: Vec<String> = series.line.iter().map(|&at| place(at)).map(|[x, y]| format!("{x},{y}")).collect();
            let legend_at = [right + 18.0, top + 8.0 + LINE * i as f64];
            let plain = Mark { at: [0.0; 2], title: String::new(), number: String::new(), hollow: false };
            Drawn {
                name: series.name.clone(),
                color: COLORS[i % COLORS.len()],
                line: line.join(" "),
                marks: series.marks.iter().map(draw).collect(),
                legend: DrawnMark::new(i, legend_at, &plain),
            }
        });
        let ratio = labels.top.map(|(_, one)| x.divided_by(one));
        Some(Self {
            size: SIZE,
            plot: PLOT,
            x_label: labels.x.to_owned(),
            y_label: labels.y.to_owned(),
            top_label: labels.top.map(|(label, _)| label.to_owned()),
            x_ticks: x.ticks(),
            y_ticks: y.ticks(),
            top_ticks: ratio.map_or_else(Vec::new, |axis| axis.ticks()),
            series: drawn.collect(),
        })
    }
}

impl DrawnMark {
    fn new(series: usize, at: [f64; 2], mark: &Mark) -> Self {
        Self {
            path: SHAPES[series % SHAPES.len()].path(at),
            at,
            title: mark.title.clone(),
            number: mark.number.clone(),
            hollow: mark.hollow,
        }
    }
}

impl Shape {
    /// As the path of an SVG.
    fn path(&self, [x, y]: [f64; 2]) -> String {
        let r = MARKER;
        if self.corners == 0 {
            return format!("M{},{y}a{r},{r} 0 1 0 {},0a{r},{r} 0 1 0 -{},0z", rounded(x - r), 2.0 * r, 2.0 * r);
        }
        // Of about the circle's area.
        let radius = if self.corners == 3 { 1.35 * r } else { 1.25 * r };
        let corner = |i: u32| {
            let angle = TAU * (self.turn + f64::from(i) / f64::from(self.corners));
            format!("{},{}", rounded(x + radius * angle.cos()), rounded(y + radius * angle.sin()))
        };
        format!("M{}z", (0..self.corners).map(corner).collect::<Vec<_>>().join("L"))
    }
}

/// A hundredth of a pixel is enough.
fn rounded(pixels: f64) -> f64 {
    (100.0 * pixels).round() / 100.0
}

/// From values to pixels.
#[derive(Debug, Clone, Copy)]
struct Axis {
    scale: Scale,
    /// Its first and last value, as the scale lays them out.
    ends: [f64; 2],
    pixels: [f64; 2],
}

impl Scale {
    /// What is proportional to lengths.
    fn of(self, value: f64) -> f64 {
        match self {
            Self::Log => value.log10(),
            Self::Linear => value,
        }
    }
}

impl Axis {
    /// An axis over all values, with a margin; none without a value.
    fn over(values: impl Iterator<Item = f64>, pixels: [f64; 2], scale: Scale) -> Option<Self> {
        let [low, high] = values
            .map(|value| scale.of(value))
            .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| [low.min(value), high.max(value)]);
        // Where there is hardly a range, at least a factor of two either way, or one; else a twentieth of it.
        let least = match scale {
            Scale::Log if high - low < 0.3 => 0.3,
            Scale::Linear if high == low => 1.0,
            _ => 0.0,
        };
        let margin = f64::max(0.05 * (high - low), least);
        (low.is_finite() && high.is_finite()).then_some(Self { scale, ends: [low - margin, high + margin], pixels })
    }

    /// The same places for values divided by `one`; of a logarithmic axis.
    fn divided_by(self, one: f64) -> Self {
        Self { ends: self.ends.map(|log| log - one.log10()), ..self }
    }

    fn place(&self, value: f64) -> f64 {
        let share = (self.scale.of(value) - self.ends[0]) / (self.ends[1] - self.ends[0]);
        self.pixels[0] + share * (self.pixels[1] - self.pixels[0])
    }

    fn ticks(&self) -> Vec<Tick> {
        let tick = |value: f64, label: String| Tick { at: rounded(self.place(value)), label };
        match self.scale {
            Scale::Log => self.log_ticks(tick),
            Scale::Linear => self.even_ticks(tick),
        }
    }

    /// At powers of ten; with their multiples by 2 and 5, or by all digits, where those are fewer than three.
    fn log_ticks(&self, tick: impl Fn(f64, String) -> Tick) -> Vec<Tick> {
        let [low, high] = self.ends;
        let decades = || low.floor() as i32..=high.ceil() as i32;
        let at = |digits: &'static [u32]| {
            decades()
                .flat_map(move |decade| digits.iter().map(move |&digit| (digit, decade)))
                .filter(move |&(digit, decade)| (low..=high).contains(&(f64::from(digit).log10() + f64::from(decade))))
        };
        let choices: [&[u32]; 3] = [&[1], &[1, 2, 5], &[1, 2, 3, 4, 5, 6, 7, 8, 9]];
        let digits = choices.into_iter().find(|digits| at(digits).count() >= 3).unwrap_or(choices[2]);
        at(digits).map(|(digit, decade)| tick(f64::from(digit) * 10f64.powi(decade), decimal(digit, decade))).collect()
    }

    /// At multiples of 1, 2 or 5 times a power of ten, the smallest that leaves no more than eight.
    fn even_ticks(&self, tick: impl Fn(f64, String) -> Tick) -> Vec<Tick> {
        let [low, high] = self.ends;
        let decade = (high - low).log10().floor() as i32 - 1;
        let multiples = |step: f64| (low / step).ceil() as i64..=(high / step).floor() as i64;
        let steps = (decade..).flat_map(|decade| [1, 2, 5].map(|digit| (digit, decade)));
        let (digit, decade) = steps
            .into_iter()
            .find(|&(digit, decade)| multiples(f64::from(digit) * 10f64.powi(decade)).count() <= 8)
            .expect("steps grow without end");
        let decimals = usize::try_from(-decade).unwrap_or_default();
        multiples(f64::from(digit) * 10f64.powi(decade))
            .map(|i| i as f64 * f64::from(digit) * 10f64.powi(decade))
            .map(|value| tick(value, format!("{value:.decimals$}")))
            .collect()
    }
}

/// `digit` · 10^`decade`, written out where that is short.
fn decimal(digit: u32, decade: i32) -> String {
    match decade {
        0..=5 => format!("{digit}{}", "0".repeat(decade as usize)),
        -4..=-1 => format!("0.{}{digit}", "0".repeat((-decade - 1) as usize)),
        _ => format!("{digit}e{decade}"),
    }
}

/// A number of three digits.
pub fn short(value: f64) -> String {
    let magnitude = value.abs();
    if magnitude == 0.0 {
        "0".into()
    } else if magnitude < 1e-4 {
        format!("{value:.1e}")
    } else {
        // Of the rounded number: 99.99 is 100.
        let scientific = format!("{magnitude:.2e}");
        let decade: i32 = scientific.split_once('e').and_then(|(_, decade)| decade.parse().ok()).unwrap_or_default();
        let decimals = (2 - decade).max(0) as usize;
        format!("{value:.decimals$}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(low: f64, high: f64) -> Vec<String> {
        let axis = Axis { scale: Scale::Log, ends: [low.log10(), high.log10()], pixels: [0.0, 100.0] };
        axis.ticks().into_iter().map(|tick| tick.label).collect()
    }

    #[test]
    fn ticks_are_round_numbers_and_at_least_three() {
        assert_eq!(labels(0.0005, 2.0), ["0.001", "0.01", "0.1", "1"]);
        assert_eq!(labels(1.5, 60.0), ["2", "5", "10", "20", "50"]);
        assert_eq!(labels(30.0, 70.0), ["30", "40", "50", "60", "70"]);
        assert_eq!(labels(5e-8, 5e7).first().map(String::as_str), Some("1e-7"));
    }

    #[test]
    fn places_are_logarithmic() {
        let axis = Axis { scale: Scale::Log, ends: [0.0, 2.0], pixels: [0.0, 100.0] };
        assert_eq!([1.0, 10.0, 100.0].map(|value| axis.place(value)), [0.0, 50.0, 100.0]);
        assert_eq!(axis.divided_by(10.0).place(1.0), 50.0);
    }

    #[test]
    fn even_ticks_are_round_numbers_and_at_most_eight() {
        let labels = |ends: [f64; 2]| -> Vec<String> {
            let axis = Axis { scale: Scale::Linear, ends, pixels: [0.0, 100.0] };
            axis.ticks().into_iter().map(|tick| tick.label).collect()
        };
        assert_eq!(labels([-2.35, 49.35]), ["0", "10", "20", "30", "40"]);
        assert_eq!(labels([0.0, 0.31]), ["0.00", "0.05", "0.10", "0.15", "0.20", "0.25", "0.30"]);
        assert_eq!(labels([-1.0, 1.0]), ["-1.0", "-0.5", "0.0", "0.5", "1.0"]);
        let axis = Axis::over([5.0].into_iter(), [0.0, 100.0], Scale::Linear).expect("a value");
        assert_eq!(axis.place(5.0), 50.0);
    }

    #[test]
    fn numbers_have_three_digits() {
        assert_eq!(
            [0.0123456, 1.0, 12.345, 1234.5, -0.5, 0.0].map(short),
            ["0.0123", "1.00", "12.3", "1234", "-0.500", "0"]
        );
        assert_eq!([0.0000123, 99.999, 0.09999].map(short), ["1.2e-5", "100", "0.100"]);
    }
}
