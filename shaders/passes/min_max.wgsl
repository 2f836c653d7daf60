// The levels of a min-max pyramid: see lib/min_max.wgsl.

#import "lib/min_max.wgsl"

@group(0) @binding(4) var finer: texture_2d_array<f32>;
@group(0) @binding(5) var coarser: texture_storage_2d_array<rgba32float, write>;

/// Whether nodes may be tilted.
override slopes: bool;
/// Texels beyond its own, to the right and above, that a node bounds too.
override reach: i32;
/// Texels a side of a node of the finer level.
override side: i32;

/// Of no texels.
const NOTHING = Node(vec2(0.0), 1.0e30, -1.0e30);

/// Room for the roundings of up to sixteen operations, each to 2^-23 whichever way it rounds, relative to the sum of the operands.
const ROUNDING: f32 = 0x1p-19;

/// Without slopes nothing is rounded: a minimum is exact.
fn widened(node: Node, magnitude: f32, is_tilted: bool) -> Node {
    let room = select(0.0, ROUNDING * magnitude, is_tilted);
    return Node(node.slope, node.low - room, node.high + room);
}

/// The node of this slope that holds a 2 x 2 block of texels and those within reach.
fn over_texels(first: vec2<i32>, layer: u32, slope: vec2<f32>) -> Node {
    let last = map_last();
    var node = Node(slope, NOTHING.low, NOTHING.high);
    var magnitude = 0.0;
    for (var y = 0; y < 2 + reach; y++) {
        for (var x = 0; x < 2 + reach; x++) {
            let texel = min(first + vec2(x, y), last);
            let depth = textureLoad(shadow_depth, texel, layer, 0);
            let tilt = slope * vec2<f32>(texel - first);
            let level = depth - (tilt.x + tilt.y);
            node.low = min(node.low, level);
            node.high = max(node.high, level);
            magnitude = max(magnitude, depth + abs(tilt.x) + abs(tilt.y));
        }
    }
    return widened(node, magnitude, any(slope != vec2(0.0)));
}

@compute @workgroup_size(8, 8)
fn from_map(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id.xy >= textureDimensions(coarser))) {
        return;
    }
    let first = 2 * vec2<i32>(id.xy);
    let last = map_last();
    var node = NOTHING;
    if (all(first <= last)) {
        node = over_texels(first, id.z, vec2(0.0));
        if (slopes && all(first < last)) {
            let a = textureLoad(shadow_depth, first, id.z, 0);
            let b = textureLoad(shadow_depth, first + vec2(1, 0), id.z, 0);
            let c = textureLoad(shadow_depth, first + vec2(0, 1), id.z, 0);
            let d = textureLoad(shadow_depth, first + vec2(1, 1), id.z, 0);
            let tilted = over_texels(first, id.z, 0.5 * vec2((b - a) + (d - c), (c - a) + (d - b)));
            if (tilted.high - tilted.low < node.high - node.low) {
                node = tilted;
            }
        }
    }
    textureStore(coarser, id.xy, id.z, vec4(node.slope, node.low, node.high));
}

fn child_at(first: vec2<i32>, i: i32, layer: u32) -> Node {
    let found = textureLoad(finer, first + vec2(i & 1, i >> 1u), layer, 0);
    return Node(found.xy, found.z, found.w);
}

/// The node of this slope that holds its four children.
fn over_nodes(first: vec2<i32>, layer: u32, slope: vec2<f32>) -> Node {
    var node = Node(slope, NOTHING.low, NOTHING.high);
    var magnitude = 0.0;
    var is_tilted = any(slope != vec2(0.0));
    let last = f32(side - 1 + reach);
    for (var i = 0; i < 4; i++) {
        let child = child_at(first, i, layer);
        if (child.low > child.high) {
            continue;
        }
        // d - slope . (i - first) = (d - slope' . (i - first')) + (slope' - slope) . (i - first') - slope . (first' - first)
        let turn = last * (child.slope - slope);
        let tilt = slope * f32(side) * vec2(f32(i & 1), f32(i >> 1u));
        let low = child.low + (min(turn.x, 0.0) + min(turn.y, 0.0) - (tilt.x + tilt.y));
        let high = child.high + (max(turn.x, 0.0) + max(turn.y, 0.0) - (tilt.x + tilt.y));
        node.low = min(node.low, low);
        node.high = max(node.high, high);
        is_tilted = is_tilted || any(child.slope != vec2(0.0));
        let sizes = last * (abs(child.slope) + abs(slope)) + abs(tilt);
        magnitude = max(magnitude, max(abs(child.low), abs(child.high)) + sizes.x + sizes.y);
    }
    if (node.low > node.high) {
        return NOTHING;
    }
    return widened(node, magnitude, is_tilted);
}

/// Depth that a child's planes have in the middle of its texels.
fn middle_of(child: Node) -> f32 {
    return 0.5 * (child.low + child.high) + 0.5 * f32(side - 1) * (child.slope.x + child.slope.y);
}

@compute @workgroup_size(8, 8)
fn from_nodes(@builtin(global_invocation_id) id: vec3<u32>) {
    if (any(id.xy >= textureDimensions(coarser))) {
        return;
    }
    let first = 2 * vec2<i32>(id.xy);
    var node = over_nodes(first, id.z, vec2(0.0));
    let last = child_at(first, 3, id.z);
    if (slopes && last.low <= last.high) {
        let a = middle_of(child_at(first, 0, id.z));
        let b = middle_of(child_at(first, 1, id.z));
        let c = middle_of(child_at(first, 2, id.z));
        let d = middle_of(last);
        let tilted = over_nodes(first, id.z, 0.5 / f32(side) * vec2((b - a) + (d - c), (c - a) + (d - b)));
        if (tilted.high - tilted.low < node.high - node.low) {
            node = tilted;
        }
    }
    textureStore(coarser, id.xy, id.z, vec4(node.slope, node.low, node.high));
}
