// Cut-outs: where a material has no surface. Twin of `Cutout::is_solid` and `Texture::sample`.

struct Cutout {
    /// Alpha below this is a hole; 0 for what is solid everywhere.
    cutoff: f32,
    /// Multiplies the texture's alpha.
    factor: f32,
    /// 1: nearest texel instead of bilinear.
    nearest: u32,
    padding: u32,
    /// Along u and v: 0 repeats, 1 repeats mirrored, 2 continues the border.
    wrap: vec2<u32>,
}

@group(0) @binding(8) var<uniform> cutout: Cutout;
@group(0) @binding(9) var cutout_alpha: texture_2d<f32>;

fn wrapped(at: i32, size: i32, wrap: u32) -> i32 {
    if (wrap == 2u) {
        return clamp(at, 0, size - 1);
    }
    let period = select(size, 2 * size, wrap == 1u);
    let position = ((at % period) + period) % period;
    return select(position, 2 * size - 1 - position, position >= size);
}

fn alpha_texel(x: i32, y: i32) -> f32 {
    let size = vec2<i32>(textureDimensions(cutout_alpha));
    return textureLoad(cutout_alpha, vec2(wrapped(x, size.x, cutout.wrap.x), wrapped(y, size.y, cutout.wrap.y)), 0).r;
}

fn is_hole(uv: vec2<f32>) -> bool {
    let at = uv * vec2<f32>(textureDimensions(cutout_alpha));
    if (cutout.nearest == 1u) {
        let texel = vec2<i32>(floor(at));
        return cutout.factor * alpha_texel(texel.x, texel.y) < cutout.cutoff;
    }
    let corner = floor(at - 0.5);
    let fraction = at - 0.5 - corner;
    let c = vec2<i32>(corner);
    let top = mix(alpha_texel(c.x, c.y), alpha_texel(c.x + 1, c.y), fraction.x);
    let bottom = mix(alpha_texel(c.x, c.y + 1), alpha_texel(c.x + 1, c.y + 1), fraction.x);
    return cutout.factor * mix(top, bottom, fraction.y) < cutout.cutoff;
}
