// Percentage-closer soft shadows, from one map of the light's centre. Fernando 2005, "Percentage-Closer Soft Shadows".

#import "lib/pcss.wgsl"

@group(0) @binding(4) var<storage, read_write> visibility: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let found = percentage_closer(points[0], receivers[id.x]);
    count(found.texels);
    visibility[id.x] = found.visibility;
}
