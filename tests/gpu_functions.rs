//! Every WGSL function that has a twin in Rust agrees with it: run on the device, on random and on extreme inputs.

mod common;

use std::f64::consts::PI;
use std::sync::{Arc, LazyLock};

use common::*;
use glam::{DAffine3, DVec2, DVec3, Vec2};
use penumbra::geometry::irradiance;
use penumbra::gpu::Gpu;
use penumbra::gpu::emission::Emission;
use penumbra::gpu::pass::Frame;
use penumbra::gpu::shader::{Pipeline, Source};
use penumbra::receivers::{Receiver, UNKNOWN};
use penumbra::sampling::{Pattern, Sampler, disk_from_square, grid_of, hash};
use penumbra::scene::light::{Domain, Emitter};
use penumbra::scene::{AreaLight, Cone, Cutout, Shape, Texture, Wrap};
use wgpu::BindingResource;

/// One adapter for all tests.
static GPU: LazyLock<Gpu> = LazyLock::new(|| Gpu::open().expect("a GPU, or a software one"));

/// Half an ulp of f32, relative.
const U: f64 = 1.0 / 16_777_216.0;

/// Runs statements on the device once for each of the inputs, words `a` to results `r`; `f(a[i])` reads a word as f32 and `w(x)`
/// makes one of it.
fn run<const N: usize, const M: usize>(
    library: &str,
    body: &str,
    inputs: &[[u32; N]],
    resources: &[(&str, BindingResource)],
) -> Vec<[u32; M]>
where
    [u32; N]: bytemuck::Pod,
    [u32; M]: bytemuck::Pod,
{
    let text = format!(
        "#import \"{library}\"
        @group(0) @binding(100) var<storage, read> inputs: array<array<u32, {N}>>;
        @group(0) @binding(101) var<storage, read_write> results: array<array<u32, {M}>>;
        fn f(word: u32) -> f32 {{ return bitcast<f32>(word); }}
        fn w(value: f32) -> u32 {{ return bitcast<u32>(value); }}
        @compute @workgroup_size(64)
        fn main(@builtin(global_invocation_id) id: vec3<u32>) {{
            if (id.x >= arrayLength(&inputs)) {{ return; }}
            var a = inputs[id.x];
            var r: array<u32, {M}>;
            {body}
            results[id.x] = r;
        }}"
    );
    let pipeline = Pipeline::compute(&GPU, &Source::new("test", &text), "main", &[]);
    let given = GPU.buffer("inputs", inputs, wgpu::BufferUsages::STORAGE).expect("fits");
    let bytes = (inputs.len() * size_of::<[u32; M]>()) as u64;
    let results = GPU.empty_buffer("results", bytes, wgpu::BufferUsages::STORAGE).expect("fits");
    let mut frame = Frame::new(&GPU);
    let mut pass = frame.compute("test", &pipeline).bind("inputs", &given).bind("results", &results);
    for (name, resource) in resources {
        pass = pass.bind(name, penumbra::gpu::pass::Resource(resource.clone()));
    }
    pass.dispatch([(inputs.len() as u32).div_ceil(64), 1, 1]);
    frame.finish().expect("runs");
    GPU.read_buffer(&results).expect("reads")
}

fn word(random: &mut Random) -> u32 {
    // Extreme ones among random ones, of any number of bits.
    match random.below(8) {
        0 => 0,
        1 => u32::MAX,
        2 => 1 << random.below(32),
        _ => (random.bits() as u32) >> random.below(32),
    }
}

#[test]
fn the_hash_is_equal_bit_for_bit() {
    let mut random = Random(41);
    let inputs: Vec<[u32; 1]> = (0..10_000).map(|_| [word(&mut random)]).collect();
    let found: Vec<[u32; 1]> = run("lib/sampling.wgsl", "r[0] = hash(a[0]);", &inputs, &[]);
    for (input, found) in inputs.iter().zip(found) {
        assert_eq!(found[0], hash(input[0]), "{input:?}");
    }
}

#[test]
fn samples_agree_with_their_twins() {
    let patterns = [Pattern::Grid, Pattern::Jittered, Pattern::Halton, Pattern::Sobol];
    let mut random = Random(42);
    for (number, pattern) in (0..).zip(patterns) {
        let mut inputs = Vec::new();
        let mut expected = Vec::new();
        for i in 0..20_000 {
            let count = [1, 2, 7, 64, 1024, 65_536, 1 << 24][i % 7];
            let (receiver, seed) = (word(&mut random), word(&mut random));
            let index = if i % 5 == 0 { count - 1 } else { random.below(count as usize) as u32 };
            let (columns, rows) = grid_of(count);
            inputs.push([number, columns, rows, receiver, seed, index]);
            expected.push(Sampler::new(pattern, count, receiver, seed).unit_square(index));
        }
        let body = "let at = unit_square(sampler_of(a[0], vec2(a[1], a[2]), a[3], a[4]), a[5]);
            r[0] = w(at.x); r[1] = w(at.y);";
        let found: Vec<[u32; 2]> = run("lib/sampling.wgsl", body, &inputs, &[]);
        for ((input, found), expected) in inputs.iter().zip(found).zip(expected) {
            let found = found.map(|word| f64::from(f32::from_bits(word)));
            for (found, expected) in found.into_iter().zip(expected.to_array()) {
                assert!((0.0..1.0).contains(&found), "{pattern:?} {input:?}: {found}");
                let difference = expected - found;
                let agrees = match pattern {
                    // Rounded down to 2^-24, the twin itself rounded to an ulp of f64 where it sums fractions.
                    Pattern::Halton | Pattern::Sobol => (-f64::EPSILON..U + f64::EPSILON).contains(&difference),
                    // The offset's 24 bits, an f32's sum (half an ulp) and quotient (WGSL's 2.5 ulp), relative to at most 1.
                    Pattern::Grid | Pattern::Jittered => difference.abs() <= U + U + 5.0 * U,
                };
                assert!(agrees, "{pattern:?} {input:?}: expected {expected}, found {found}");
            }
        }
    }
}

#[test]
fn the_disk_map_agrees_with_its_twin() {
    let mut random = Random(43);
    let mut inputs: Vec<[f32; 2]> = Vec::new();
    let extremes = [0.0, 0.5, 0.25, f32::MIN_POSITIVE, 0.5 + f32::EPSILON, 1.0 - f32::EPSILON / 2.0, 1.0];
    for x in extremes {
        inputs.extend(extremes.map(|y| [x, y]));
    }
    inputs.extend((0..20_000).map(|_| [random.between(0.0, 1.0) as f32, random.between(0.0, 1.0) as f32]));
    let words: Vec<[u32; 2]> = inputs.iter().map(|input| input.map(f32::to_bits)).collect();
    let body = "let at = disk_from_square(vec2(f(a[0]), f(a[1]))); r[0] = w(at.x); r[1] = w(at.y);";
    let found: Vec<[u32; 2]> = run("lib/sampling.wgsl", body, &words, &[]);
    for (input, found) in inputs.iter().zip(found) {
        let expected = disk_from_square(Vec2::from(*input).as_dvec2());
        let found = Vec2::from(found.map(f32::from_bits)).as_dvec2();
        // The coordinates (a rounding each, of which the quotient has two), the quotient (2.5 ulp), π/4 and the product (half an
        // ulp each), all times π/4: less than 8 U of angle; the series (1 U, and 3 for its roundings), the last product 1 U, the
        // radius 1 U.
        assert!((found - expected).abs().max_element() <= 14.0 * U, "{input:?}: expected {expected}, found {found}");
    }
}

/// A light with some emission, and what it is seen from; all that both sides read is in f32.
struct Case {
    light: AreaLight,
    emitter: Emitter,
    receiver: Receiver,
    to_light: DVec3,
}

fn case(random: &mut Random) -> Case {
    let shape = match random.below(6) {
        0 => Shape::Point,
        1 => Shape::Sun { angle: 0.0 },
        2 => Shape::Sun { angle: 0.1 },
        3 => Shape::Sphere { radius: 1.0, facing: false },
        _ => Shape::Rect { size: DVec2::ONE },
    };
    let single = |v: DVec3| v.as_vec3().as_dvec3();
    let pose = DAffine3 { matrix3: random.rotation(), translation: DVec3::ZERO };
    let mut light = AreaLight::new("light", pose, shape);
    let size = 10f64.powf(random.between(-8.0, 8.0));
    let to_light = single(size * random.direction());
    // One in two points nearly at the receiver, which is where cones and spreads are narrow.
    if random.chance(0.5) {
        let direction = -to_light.normalize() + 10f64.powf(random.between(-5.0, 0.0)) * random.direction();
        light.scene_from_light.matrix3 = penumbra::scene::camera::aimed(direction, random.direction());
    }
    if random.chance(0.5) {
        let outer = [PI / 2.0, 0.8, 0.1, 1e-3][random.below(4)];
        let inner = outer * [0.0, 0.5, 0.9][random.below(3)];
        light.cone = Some(Cone { inner, outer });
    }
    if random.chance(0.5) {
        light.spread = [PI - 1e-6, 3.0, 1.0, 0.1, 1e-3, 0.0][random.below(6)];
    }
    let normal = single(random.direction());
    let near_normal = single((normal + 0.5 * random.in_cube(1.0)).normalize());
    let emitter = Emitter {
        domain: if shape.is_point() { Domain::Point } else { Domain::Rect },
        center: to_light,
        half_u: DVec3::X,
        half_v: DVec3::Y,
        normal: single(light.axis()),
        distant: matches!(shape, Shape::Sun { .. }),
    };
    let receiver = Receiver {
        position: DVec3::ZERO,
        position_error: 0.0,
        normal,
        shading_normal: if random.chance(0.5) { normal } else { near_normal },
        depth: 0.0,
        instance: UNKNOWN,
        triangle: UNKNOWN,
        barycentric: [0.0; 2],
    };
    Case { light, emitter, receiver, to_light }
}

impl Case {
    /// A bound on the error of the weight times r² (for a distant point the weight): see `sample_weight` in the shader for that
    /// of the cosines. Factors come from the same quantities: a dot product of unit vectors is off by 3 U, a quotient by 5 U.
    fn bound(&self) -> f64 {
        let toward = self.to_light.normalize();
        let cos_light = -self.emitter.normal.dot(toward);
        let mut factor = 1.0;
        let mut error = 0.0;
        if let Some(cone) = self.light.cone {
            let versine = |angle: f64| 2.0 * (0.5 * angle).sin().powi(2);
            let (inner, outer) = (versine(cone.inner), versine(cone.outer));
            let across = (toward + self.light.axis()).length();
            // The unit vector is off by 16 U (root, quotient), the axis by 1, their difference by 1: times the difference's length
            // for its square's half, 4 U of its own, and the roundings of the bounds. The square of the quotient doubles it.
            let at = 18.0 * U * (across + 18.0 * U) + 4.0 * U * versine_of(across) + U * (inner + outer);
            error += 2.0 * at / (outer - inner) + 24.0 * U;
        }
        if let (true, Some((tan, norm))) =
            (self.emitter.domain != Domain::Point, irradiance::spread_slopes(&self.light))
        {
            if norm == 0.0 {
                return 0.0;
            }
            let tan_theta = (toward + cos_light * self.emitter.normal).length() / cos_light;
            if cos_light > 0.0 && tan_theta * (1.0 - 30.0 * U / cos_light) - 30.0 * U / cos_light < tan {
                // Depth is off by 3 U of the distance; so is the vector across, by 5 U, and its length by 9 U of itself.
                let slope = U * (8.0 / cos_light + 14.0 * tan_theta + 3.0 * tan_theta / cos_light + tan);
                error = error * tan / norm + (slope + 6.0 * U * tan) / norm;
                factor = tan / norm;
            }
        }
        let cosine = if self.emitter.domain == Domain::Point { 1.0 } else { cos_light.max(0.0) + 19.0 * U };
        48.0 * U * factor + error * cosine
    }
}

fn versine_of(chord: f64) -> f64 {
    0.5 * chord * chord
}

#[test]
fn weights_of_light_points_agree_with_their_twin() {
    let mut random = Random(44);
    let cases: Vec<Case> = (0..50_000).map(|_| case(&mut random)).collect();
    let inputs: Vec<[u32; 20]> = cases
        .iter()
        .map(|case| {
            let mut words = [0; 20];
            let vectors = [case.emitter.normal, case.receiver.normal, case.receiver.shading_normal, case.to_light];
            words[..8].copy_from_slice(bytemuck::cast_slice(&[Emission::of(&case.light)]));
            for (place, vector) in words[8..].chunks_exact_mut(3).zip(vectors) {
                place.copy_from_slice(&vector.as_vec3().to_array().map(f32::to_bits));
            }
            words
        })
        .collect();
    let body = "let emission = Emission(
            vec3(f(a[0]), f(a[1]), f(a[2])), a[3], f(a[4]), f(a[5]), f(a[6]), f(a[7]));
        r[0] = w(sample_weight(
            emission,
            vec3(f(a[8]), f(a[9]), f(a[10])),
            vec3(f(a[11]), f(a[12]), f(a[13])),
            vec3(f(a[14]), f(a[15]), f(a[16])),
            vec3(f(a[17]), f(a[18]), f(a[19])),
        ));";
    let found: Vec<[u32; 1]> = run("lib/emission.wgsl", body, &inputs, &[]);
    let (mut positive, mut varied) = (0, 0);
    for (case, found) in cases.iter().zip(found) {
        let Case { light, emitter, receiver, to_light } = case;
        let found = f64::from(f32::from_bits(found[0]));
        let expected = irradiance::sample_weight(light, emitter, receiver, *to_light);
        let scale = if emitter.domain == Domain::Point && emitter.distant { 1.0 } else { to_light.length_squared() };
        // On the horizon either side may say no: what is there is within the bound all the same, but for shading normals.
        if receiver.normal.dot(to_light.normalize()).abs() <= 4.0 * U {
            continue;
        }
        let bound = case.bound();
        let difference = (found - expected).abs() * scale;
        assert!(
            difference <= bound,
            "{light:?} {to_light}: expected {expected}, found {found}: {difference} > {bound}"
        );
        positive += usize::from(expected > 0.0);
        varied += usize::from(expected > 0.0 && (light.cone.is_some() || light.spread < PI));
    }
    assert!(positive > 5_000 && varied > 1_000, "{positive} {varied}");
}

#[test]
fn cut_outs_agree_with_their_twin() {
    let mut random = Random(45);
    let mut judged = 0;
    for wraps in [
        [Wrap::Repeat, Wrap::MirroredRepeat],
        [Wrap::MirroredRepeat, Wrap::ClampToEdge],
        [Wrap::ClampToEdge, Wrap::Repeat],
    ] {
        for (nearest, size) in [(false, [5, 8]), (true, [8, 5]), (false, [1, 1]), (true, [1, 3])] {
            let texels: Vec<[u8; 1]> = (0..size[0] * size[1]).map(|_| [random.bits() as u8]).collect();
            let texture = Texture { size, texels, srgb: false, nearest, wrap: wraps };
            let (cutoff, factor) = (0.45f32, 0.9f32);
            let number = |wrap| match wrap {
                Wrap::Repeat => 0,
                Wrap::MirroredRepeat => 1,
                Wrap::ClampToEdge => 2,
            };
            let parameters =
                [cutoff.to_bits(), factor.to_bits(), nearest.into(), 0, number(wraps[0]), number(wraps[1])];
            let parameters = GPU.buffer("cutout", &[parameters], wgpu::BufferUsages::UNIFORM).expect("fits");
            let usage = wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST;
            let format = wgpu::TextureFormat::R8Unorm;
            let alpha = GPU.texture("alpha", [size[0], size[1], 1], format, usage).expect("fits");
            GPU.queue.write_texture(
                alpha.as_image_copy(),
                texture.texels.as_flattened(),
                wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(size[0]), rows_per_image: None },
                alpha.size(),
            );
            let alpha = alpha.create_view(&wgpu::TextureViewDescriptor::default());
            // Up to where a texel is lost in an f32, and beyond, where all that counts is that it comes to an end.
            let uvs: Vec<[f32; 2]> = (0..5_000)
                .map(|i| {
                    let reach = [1.0, 3.0, 100.0, 1e4, 1e12][i % 5];
                    [random.between(-reach, reach) as f32, random.between(-reach, reach) as f32]
                })
                .chain([[0.0; 2], [1.0; 2], [-1.0; 2], [f32::MAX; 2], [f32::MIN, 0.0], [f32::MIN_POSITIVE; 2]])
                .collect();
            let inputs: Vec<[u32; 2]> = uvs.iter().map(|uv| uv.map(f32::to_bits)).collect();
            let resources =
                [("cutout", parameters.as_entire_binding()), ("cutout_alpha", BindingResource::TextureView(&alpha))];
            let body = "r[0] = select(0u, 1u, is_hole(vec2(f(a[0]), f(a[1]))));";
            let found: Vec<[u32; 1]> = run("lib/cutout.wgsl", body, &inputs, &resources);
            let cutout = Cutout { cutoff, factor, texture: Some(Arc::new(texture.clone())) };
            for (uv, found) in uvs.iter().zip(found) {
                let uv = Vec2::from(*uv).as_dvec2();
                let at = uv * DVec2::new(size[0].into(), size[1].into());
                // The product's rounding and that of half a texel's shift.
                let error = 2.0 * U * at.abs() + U;
                if nearest {
                    if (at - at.round()).abs().cmple(error).any() {
                        continue;
                    }
                } else {
                    // Alpha changes by at most 1 a texel along each axis; two mixtures of three roundings each, on both sides, and
                    // the texels' and the factor's.
                    let margin = f64::from(factor) * (error.element_sum() + 16.0 * U);
                    if (f64::from(factor * texture.sample(uv)[0]) - f64::from(cutoff)).abs() <= margin {
                        continue;
                    }
                }
                judged += 1;
                assert_eq!(found[0] == 0, cutout.is_solid(uv), "{wraps:?} {nearest} {size:?} at {uv}");
            }
        }
    }
    // Four in five are at places that an f32 can tell; few of them are ties.
    assert!(judged > 12 * 3_500, "{judged}");
}
