// Sample patterns on a light. Twin of `crate::sampling`.
//
// All that picks a sample is on u32 and equal bit for bit. What becomes a fraction keeps its top 24 bits, so that it stays below
// 1 in f32: it is at most the twin's, by less than 2^-24.

/// The samples of one receiver. Twin of `Sampler`.
struct Sampler {
    /// 0 grid, 1 jittered, 2 Halton, 3 Sobol'.
    pattern: u32,
    /// Columns and rows of the grid of cells; their product is the count of samples.
    cells: vec2<u32>,
    /// Another at each receiver.
    seed: u32,
}

/// `seed` chooses another set altogether; `cells` is the twin's `grid_of`.
fn sampler_of(pattern: u32, cells: vec2<u32>, receiver: u32, seed: u32) -> Sampler {
    return Sampler(pattern, cells, hash(receiver ^ hash(seed)));
}

/// Sample `index` in [0, 1)².
fn unit_square(sampler: Sampler, index: u32) -> vec2<f32> {
    switch sampler.pattern {
        case 0u: {
            return in_cell(index, sampler.cells, vec2(0.5));
        }
        case 1u: {
            let first = hash(sampler.seed ^ hash(index));
            return in_cell(index, sampler.cells, vec2(unit(first), unit(hash(first))));
        }
        case 2u: {
            // Cranley and Patterson 1976. Fractions of 2^32 wrap around by themselves.
            let shift = vec2(hash(sampler.seed), hash(sampler.seed ^ 0x9e3779b9u));
            let point = vec2(reverseBits(index + 1u), radical_inverse_3(index + 1u));
            return vec2(unit(point.x + shift.x), unit(point.y + shift.y));
        }
        default: {
            // Owen scrambling works on reversed bits, in which the sequence is generated.
            let x = laine_karras(index, hash(sampler.seed ^ 0x68bc21ebu));
            let y = laine_karras(sobol_second_reversed(index), hash(sampler.seed ^ 0x02e5be93u));
            return vec2(unit(reverseBits(x)), unit(reverseBits(y)));
        }
    }
}

/// A place in a cell of the grid, the cell's `offset` in [0, 1)²; below 1 whatever the rounding.
fn in_cell(index: u32, cells: vec2<u32>, offset: vec2<f32>) -> vec2<f32> {
    let cell = vec2(index % cells.x, index / cells.x);
    return min((vec2<f32>(cell) + offset) / vec2<f32>(cells), vec2(BELOW_ONE));
}

/// The largest f32 below 1.
const BELOW_ONE: f32 = 0.99999994;

/// The concentric map of the unit square onto the unit disk, area-preserving (Shirley and Chiu 1997).
fn disk_from_square(square: vec2<f32>) -> vec2<f32> {
    let at = 2.0 * square - 1.0;
    if (at.x == 0.0 && at.y == 0.0) {
        return vec2(0.0);
    }
    if (abs(at.x) > abs(at.y)) {
        return at.x * cos_sin(QUARTER_PI * (at.y / at.x));
    }
    // The angle from the other axis: no difference of angles, which would round.
    return at.y * cos_sin(QUARTER_PI * (at.x / at.y)).yx;
}

/// Cosine and sine of an angle in [−π/4, π/4] by their series, to 2^-24 (the next terms, at π/4: 2.5e-8 and 1.8e-9): those of
/// the language may be off by 2^-11.
fn cos_sin(angle: f32) -> vec2<f32> {
    let x = angle * angle;
    let cosine = 1.0 - x * (0.5 - x * (1.0 / 24.0 - x * (1.0 / 720.0 - x / 40320.0)));
    let sine = angle * (1.0 - x * (1.0 / 6.0 - x * (1.0 / 120.0 - x * (1.0 / 5040.0 - x / 362880.0))));
    return vec2(cosine, sine);
}

const QUARTER_PI: f32 = 0.78539816;

/// A well-mixed 32-bit hash (Wellons 2018, "lowbias32").
fn hash(value: u32) -> u32 {
    var x = value;
    x ^= x >> 16u;
    x *= 0x7feb352du;
    x ^= x >> 15u;
    x *= 0x846ca68bu;
    return x ^ (x >> 16u);
}

/// A 32-bit fraction as a number in [0, 1), its lowest 8 bits left out.
fn unit(x: u32) -> f32 {
    return f32(x >> 8u) * 0x1p-24;
}

/// Owen scrambling of a 32-bit fraction in reversed bits, by Laine and Karras' hash with the constants of Vegdahl 2021.
fn laine_karras(value: u32, seed: u32) -> u32 {
    var x = value;
    x ^= x * 0x3d20adeau;
    x += seed;
    x *= (seed >> 16u) | 1u;
    x ^= x * 0x05526c56u;
    return x ^ (x * 0x53a22864u);
}

/// Second coordinate of the Sobol' sequence (primitive polynomial x + 1), as a 32-bit fraction in reversed bits.
fn sobol_second_reversed(index: u32) -> u32 {
    var left = index;
    var direction = 1u;
    var result = 0u;
    while (left != 0u) {
        if ((left & 1u) != 0u) {
            result ^= direction;
        }
        left >>= 1u;
        direction ^= direction << 1u;
    }
    return result;
}

/// The radical inverse to base 3, as a 32-bit fraction rounded down. An index of more than 20 digits loses its last one, which
/// is less than 2^-32.
fn radical_inverse_3(index: u32) -> u32 {
    var left = index;
    var digits = 0u;
    var power = 1u;
    while (left != 0u && power < 3486784401u) {
        digits = digits * 3u + left % 3u;
        power *= 3u;
        left /= 3u;
    }
    return fraction(digits, power);
}

/// ⌊2^32 · numerator/denominator⌋ for numerator < denominator.
fn fraction(numerator: u32, denominator: u32) -> u32 {
    var rest = numerator;
    var result = 0u;
    for (var bit = 0u; bit < 32u; bit++) {
        // Twice the rest may exceed 32 bits.
        let carries = rest >= 0x80000000u;
        rest <<= 1u;
        result <<= 1u;
        if (carries || rest >= denominator) {
            rest -= denominator;
            result |= 1u;
        }
    }
    return result;
}
