//! Pictures with text on them.

use embedded_graphics::mono_font::MonoTextStyle;
use embedded_graphics::mono_font::iso_8859_1::FONT_9X15;
use embedded_graphics::pixelcolor::Rgb888;
use embedded_graphics::prelude::*;
use embedded_graphics::text::{Alignment, Baseline, Text, TextStyleBuilder};
use image::{Rgb, RgbImage};

/// A picture that `embedded-graphics` draws on.
#[derive(Debug, Clone)]
pub struct Canvas(pub RgbImage);

impl Canvas {
    /// A white picture.
    pub fn new(width: u32, height: u32) -> Self {
        Self(RgbImage::from_pixel(width, height, Rgb([255; 3])))
    }

    /// Black text, its top left corner at `x, y`.
    pub fn text(&mut self, text: &str, x: u32, y: u32) {
        self.aligned_text(text, x, y, Alignment::Left);
    }

    /// Black text, its top edge at `y`, its left edge, middle or right edge at `x`.
    pub fn aligned_text(&mut self, text: &str, x: u32, y: u32, alignment: Alignment) {
        let style = TextStyleBuilder::new().alignment(alignment).baseline(Baseline::Top).build();
        let letters = MonoTextStyle::new(&FONT_9X15, Rgb888::BLACK);
        let Ok(_) = Text::with_text_style(text, Point::new(x as i32, y as i32), letters, style).draw(self);
    }
}

impl OriginDimensions for Canvas {
    fn size(&self) -> Size {
        Size::new(self.0.width(), self.0.height())
    }
}

impl DrawTarget for Canvas {
    type Color = Rgb888;
    type Error = std::convert::Infallible;

    fn draw_iter<I: IntoIterator<Item = Pixel<Rgb888>>>(&mut self, pixels: I) -> Result<(), Self::Error> {
        for Pixel(at, color) in pixels {
            if let (Ok(x), Ok(y)) = (u32::try_from(at.x), u32::try_from(at.y))
                && let Some(pixel) = self.0.get_pixel_mut_checked(x, y)
            {
                *pixel = Rgb([color.r(), color.g(), color.b()]);
            }
        }
        Ok(())
    }
}
