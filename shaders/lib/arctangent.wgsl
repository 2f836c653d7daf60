// An arc tangent as good as its digits.

const PI: f32 = 3.14159265358979;

/// Of −1 to 1. The language promises 4096 roundings of its own; this series ends in less than one.
fn arctangent(x: f32) -> f32 {
    let is_large = abs(x) > 0.41421356;
    let t = select(abs(x), (abs(x) - 1.0) / (abs(x) + 1.0), is_large);
    let z = t * t;
    let series = 1.0 + z * (-1.0 / 3.0 + z * (1.0 / 5.0 + z * (-1.0 / 7.0 + z * (1.0 / 9.0 + z * (-1.0 / 11.0
        + z * (1.0 / 13.0 - z / 15.0))))));
    return sign(x) * (select(0.0, 0.25 * PI, is_large) + t * series);
}
