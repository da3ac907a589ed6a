"use strict";
// Web worker of one model: unpacks its chunks (format: src/player/track.rs), computes the state of its Gaussians at a
// time, and sorts them by depth. Each message "show" gets one answer.

const WIDTH = 2048;          // texels across
const KEPT = 400e6;          // maximum bytes of unpacked groups in memory
let track, moving, base, rows;
const packed = new Map();    // chunk -> its bytes
const groups = new Map();    // chunk -> its unpacked components, the most recently used last
let keptBytes = 0;
let last = {};               // last answer: frames a and b, position `part` between them, texels `place`
let turn = Promise.resolve();

onmessage = ({ data }) => {
    turn = turn.then(() => answers[data.kind](data)).catch((error) => postMessage({ kind: "failed", message: String(error) }));
};

const answers = {
    begin(message) {
        track = message.track;
        rows = Math.max(1, Math.ceil(track.count / WIDTH));
        moving = track.varying.flatMap(([start, count]) => Array.from({ length: count }, (_, k) => start + k));
    },
    async chunk({ place, text }) {
        const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
        packed.set(place, bytes);
        if (place === 0) {
            base = (await unpack(bytes, [...Array(11 + 3 * (track.sh_degree + 1) ** 2).keys()], 1)).values;
            packed.delete(0);
        } else if (keptBytes < KEPT / 2) await group(place);
        postMessage({ kind: "here", place });
    },
    async show({ time, sight, ticket }) {
        const state = await stateAt(time);
        const message = { kind: "shown", ticket, ...sorted(sight), ...state };
        const buffers = Object.values(message).filter((part) => ArrayBuffer.isView(part)).map((part) => part.buffer);
        postMessage(message, buffers);
    },
};

async function inflated(bytes) {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
}

/// Unpacks a chunk of `frames` frames. Returns the values of each of `components`, frame by frame, or null for a component that
/// equals `base` at all these frames. `bytes`: bytes of memory that the values take.
async function unpack(packedBytes, components, frames) {
    const bytes = await inflated(packedBytes);
    const count = track.count, size = count * frames;
    const values = [];
    let at = 0, taken = 0;
    for (const component of components) {
        const flags = bytes[at++], planes = flags & 7, isSecond = flags & 8;
        if (planes === 0 && base) {
            values.push(null);
            continue;
        }
        const out = flags & 16 ? new Int32Array(size) : new Int16Array(size);
        for (let i = 0; i < count; i++) {
            let before = base ? base[component][i] : 0, step = 0;
            for (let frame = 0; frame < frames; frame++) {
                let code = 0;
                for (let plane = 0; plane < planes; plane++) code |= bytes[at + plane * size + i * frames + frame] << (8 * plane);
                const value = (before + (isSecond ? step : 0) + ((code >>> 1) ^ -(code & 1))) | 0;
                step = frame === 0 ? 0 : (value - before) | 0;
                before = out[frame * count + i] = value;
            }
        }
        at += planes * size;
        taken += out.byteLength;
        values.push(out);
    }
    return { values, bytes: taken };
}

async function group(place) {
    let found = groups.get(place);
    if (found) groups.delete(place);
    else {
        found = await unpack(packed.get(place), moving, track.groups[place] - track.groups[place - 1]);
        keptBytes += found.bytes;
        for (const [other, { bytes }] of groups) {
            if (keptBytes <= KEPT) break;
            groups.delete(other);
            keptBytes -= bytes;
        }
    }
    groups.set(place, found);
    return found;
}

/// Returns a function that gives, for a component, an array with its quantized values, and the index where those of `frame` begin.
async function frameAt(frame) {
    if (frame === 0) return (component) => [base[component], 0];
    const place = track.groups.findIndex((first) => first > frame);
    const { values } = await group(place);
    const start = (frame - track.groups[place - 1]) * track.count;
    return (component) => {
        const k = moving.indexOf(component);
        return k < 0 || !values[k] ? [base[component], 0] : [values[k], start];
    };
}

/// Returns the two frames around a time, and the position of the time between them.
function around(time) {
    const times = track.times;
    let after = times.findIndex((t) => t > time);
    if (after < 0) return [times.length - 1, times.length - 1, 0];
    if (after === 0) return [0, 0, 0];
    const part = (time - times[after - 1]) / (times[after] - times[after - 1]);
    return part < 1e-9 ? [after - 1, after - 1, 0] : [after - 1, after, part];
}

/// Returns the attributes at `time` that differ from the last answer, as texels. Between two frames, values are interpolated
/// linearly.
async function stateAt(time) {
    const [a, b, part] = around(time);
    if (last.a === a && last.b === b && last.part === part) return {};
    const from = await frameAt(a), to = await frameAt(b);
    const steps = track.steps, changed = {};
    const texels = (Kind, layers) => new Kind(4 * WIDTH * rows * layers);
    const fill = (out, start, component, step) => {
        const [p, i0] = from(component), [q, j0] = to(component);
        for (let i = 0; i < track.count; i++) out[start + 4 * i] = (p[i0 + i] + part * (q[j0 + i] - p[i0 + i])) * step;
    };
    // Constant attributes are sent once.
    const isNew = (first) => last.a === undefined || moving.includes(first);
    if (isNew(0) || isNew(10)) {
        changed.place = texels(Float32Array, 1);
        for (let c = 0; c < 3; c++) fill(changed.place, c, c, steps.position);
        fill(changed.place, 3, 10, steps.opacity);
        last.place = changed.place.slice();
    }
    if (isNew(3)) {
        changed.turn = texels(Float32Array, 1);
        for (let c = 0; c < 4; c++) fill(changed.turn, c, 3 + c, steps.rotation);
    }
    if (isNew(7)) {
        changed.extent = texels(Float32Array, 1);
        for (let c = 0; c < 3; c++) fill(changed.extent, c, 7 + c, steps.log_scale);
    }
    if (isNew(11)) {
        const count = 3 * (track.sh_degree + 1) ** 2;
        changed.harmonics = texels(Int16Array, Math.ceil(count / 4));
        for (let c = 0; c < count; c++) fill(changed.harmonics, 4 * WIDTH * rows * (c >> 2) + (c & 3), 11 + c, 1);
    }
    Object.assign(last, { a, b, part });
    return changed;
}

const bits = new Uint32Array(1), number = new Float32Array(bits.buffer);

/// Returns the ids of the Gaussians in front of the near plane with an opacity of at least 1/255, the furthest first. Equal depths
/// have the rasterizer's order, reversed. The radix sort over both halves of the bits of the depth works because the bits of
/// positive numbers are in the order of the numbers.
function sorted({ row, eye, near }) {
    const { count } = track, place = last.place;
    const keys = new Uint32Array(count), ids = new Uint32Array(count), spare = new Uint32Array(count);
    const low = new Uint32Array(65537), high = new Uint32Array(65537);
    let seen = 0;
    for (let i = count - 1; i >= 0; i--) {
        const depth = row[0] * (place[4 * i] - eye[0]) + row[1] * (place[4 * i + 1] - eye[1]) + row[2] * (place[4 * i + 2] - eye[2]);
        if (!(depth > near) || place[4 * i + 3] < 1 / 255) continue;
        number[0] = depth;
        const key = keys[i] = ~bits[0] >>> 0;
        low[(key & 65535) + 1]++;
        high[(key >>> 16) + 1]++;
        ids[seen++] = i;
    }
    for (let k = 0; k < 65536; k++) {
        low[k + 1] += low[k];
        high[k + 1] += high[k];
    }
    for (let k = 0; k < seen; k++) spare[low[keys[ids[k]] & 65535]++] = ids[k];
    for (let k = 0; k < seen; k++) ids[high[keys[spare[k]] >>> 16]++] = spare[k];
    return { order: ids.slice(0, seen) };
}
