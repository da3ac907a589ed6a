// The player: the models, the time and the camera that are shown, and the controls. One frame is prepared at a time: the
// workers are asked for a time, and the frame is drawn when all have answered.

const el = (id) => document.getElementById(id);
const FRAMES_PER_SECOND = 30; // at speed 1
let stage, painter, models = [], span = [0, 0], camera, focus, home;
let time = 0, playing = false, cut = 0.5, exact = false, isDirty = true, isBusy = false, coarse = 1, moved = 0;
let drawn = [], waiting = [], trouble = "";

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, s = 1) => a.map((x, k) => x + s * b[k]);
const unit = (a) => a.map((x) => x / (Math.hypot(...a) || 1));
const count = (n) => n.toLocaleString("en").replaceAll(",", "\u202f");
const bytes = (n) => n < 1e6 ? `${(n / 1e3).toFixed(1)} kB` : `${(n / 1e6).toFixed(n < 1e7 ? 2 : 1)} MB`;
const fail = (error) => { el("status").textContent = trouble = error.message ?? String(error); };

class Model {
    constructor(shown, source) {
        Object.assign(this, shown, { figure: new Figure(painter, shown.track), arrived: new Set(), answer: null });
        this.worker = new Worker(source);
        this.worker.onmessage = ({ data }) => this[data.kind](data);
        this.worker.onerror = (event) => fail(event);
        this.worker.postMessage({ kind: "begin", track: shown.track });
    }
    here({ place }) {
        this.arrived.add(place);
        arrivals();
    }
    shown(message) {
        this.figure.take(message);
        this.answer();
    }
    failed({ message }) {
        fail(`The frames of ${this.name} cannot be read: ${message}`);
    }
    show(time, { rows, eye, near }) {
        return new Promise((resolve) => {
            this.answer = resolve;
            this.worker.postMessage({ kind: "show", time, sight: { row: rows[2], eye, near } });
        });
    }
    /// Last time up to which every frame has arrived.
    get until() {
        const { groups, times } = this.track;
        let place = 0;
        while (this.arrived.has(place)) place++;
        return place === 0 ? -Infinity : times[groups[place - 1] - 1];
    }
}

const player = {
    begin(told) {
        try {
            stage = told;
            painter = new Painter(el("canvas"));
            const source = URL.createObjectURL(new Blob([el("sorter").textContent], { type: "text/javascript" }));
            models = stage.models.map((shown) => new Model(shown, source));
        } catch (error) {
            models = [];
            return fail(error);
        }
        const times = models.flatMap((model) => model.track.times);
        span = times.length ? [Math.min(...times), Math.max(...times)] : [0, 0];
        time = span[0];
        setUp();
        if (stage.files.length) load(0);
        requestAnimationFrame(tick);
    },
    /// Takes a chunk of a model's frames from a script.
    chunk(model, place, text) {
        document.currentScript?.remove();
        models[model]?.worker.postMessage({ kind: "chunk", place, text });
    },
    /// Resolves when everything has arrived and the image on the canvas matches the controls at full resolution.
    settled: () => new Promise((resolve) => { waiting.push(resolve); isDirty = true; }),
    /// Returns the canvas: width, height, and red, green, blue from its top left on, in base64.
    pixels() {
        draw();
        const { gl } = painter, { width, height } = gl.canvas, rgba = new Uint8Array(4 * width * height);
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
        let text = "";
        for (let y = height - 1; y >= 0; y--) {
            for (let x = 0; x < width; x++) text += String.fromCharCode(...rgba.subarray(4 * (y * width + x), 4 * (y * width + x) + 3));
        }
        return { width, height, rgb: btoa(text) };
    },
};

/// Loads the chunks beside the page, one after the other. A page from a disk may load scripts, and nothing else.
function load(place) {
    if (place === stage.files.length) return;
    const script = document.createElement("script");
    script.src = stage.files[place];
    script.onload = () => load(place + 1);
    script.onerror = () => fail(`${stage.files[place]} is not there; it belongs beside this page.`);
    document.head.append(script);
}

function arrivals() {
    const wanted = models.reduce((sum, model) => sum + model.track.groups.length, 0);
    const here = models.reduce((sum, model) => sum + model.arrived.size, 0);
    el("status").textContent = trouble || (here < wanted ? `loading, ${Math.floor(100 * here / wanted)}%` : "");
    isDirty = true;
    return here === wanted;
}

// Camera.

const distance = () => Math.hypot(...plus(focus, camera.eye, -1));

/// Takes the place of a camera. The camera then turns around the point on its axis that is as far away as the scene's middle.
function lookFrom(look) {
    camera = { ...look, rows: look.rotation.map((row) => [...row]), eye: [...look.eye] };
    const away = dot(plus(stage.middle, look.eye, -1), look.rotation[2]);
    focus = plus(look.eye, look.rotation[2], Math.max(away, 0.1 * stage.extent));
    isDirty = true;
}

/// Returns a camera outside of the scene, for scenes without cameras.
function overview() {
    const up = unit(stage.up);
    const aside = unit(Math.abs(up[0]) < 0.9 ? plus([1, 0, 0], up, -up[0]) : plus([0, 1, 0], up, -up[1]));
    const eye = plus(plus(stage.middle, aside, 1.6 * stage.extent), up, 0.6 * stage.extent);
    const ahead = unit(plus(stage.middle, eye, -1));
    const down = unit(plus(ahead.map((x) => x * dot(up, ahead)), up, -1));
    const right = [down[1] * ahead[2] - down[2] * ahead[1], down[2] * ahead[0] - down[0] * ahead[2], down[0] * ahead[1] - down[1] * ahead[0]];
    return { size: [800, 600], focal: [800, 800], principal: [400, 300], near: 0.01 * stage.extent, rotation: [right, down, ahead], eye };
}

/// Returns whether no training camera, and no path between two of them, sees the scene from the direction of the camera.
function isOutside() {
    if (!stage.rig) return false;
    const direction = unit(plus(camera.eye, stage.rig.focus, -1));
    return stage.rig.faces.some((face) => dot(face, direction) < -stage.rig.tolerance);
}

/// Turns the camera around the focus.
function turn(axis, angle) {
    const c = Math.cos(angle), s = Math.sin(angle), along = (v) => dot(axis, v) * (1 - c);
    const rotated = (v) => [
        v[0] * c + (axis[1] * v[2] - axis[2] * v[1]) * s + axis[0] * along(v),
        v[1] * c + (axis[2] * v[0] - axis[0] * v[2]) * s + axis[1] * along(v),
        v[2] * c + (axis[0] * v[1] - axis[1] * v[0]) * s + axis[2] * along(v)];
    camera.rows = camera.rows.map(rotated);
    camera.eye = plus(focus, rotated(plus(camera.eye, focus, -1)));
}
function orbit(across, down) {
    turn(unit(stage.up), -across);
    const up = unit(stage.up), pitch = Math.asin(Math.max(-1, Math.min(1, dot(camera.rows[2], up))));
    // The camera stops before the pole, where left and right would change places.
    const wanted = Math.max(-1.5, Math.min(1.5, pitch - down));
    turn(camera.rows[0], Math.abs(pitch) > 1.5 ? -down : wanted - pitch);
    changed();
}
function pan(across, down) {
    const scale = distance() / (camera.focal[0] * fit().scale);
    for (const [row, pixels] of [[camera.rows[0], across], [camera.rows[1], down]]) {
        camera.eye = plus(camera.eye, row, -pixels * scale);
        focus = plus(focus, row, -pixels * scale);
    }
    changed();
}
function zoom(factor) {
    const least = 0.02 * stage.extent;
    factor = Math.max(factor, least / distance());
    camera.eye = plus(focus, plus(camera.eye, focus, -1), factor);
    changed();
}
function changed() {
    el("camera").value = "";
    moved = performance.now();
    isDirty = true;
}

// Drawing.

const mode = () => models.length < 2 ? "original" : el("show").value;
const seen = () => ({ original: [0], compressed: [1] })[mode()] ?? [0, 1];

/// Returns the size of one image on the canvas in CSS pixels, and its scale relative to the camera's pixels.
function fit() {
    const width = el("stage").clientWidth / (mode() === "beside" ? 2 : 1), height = el("stage").clientHeight;
    return { width, height, scale: Math.min(width / camera.size[0], height / camera.size[1]) };
}
/// Returns the camera parameters for one image on the canvas, in pixels of this image.
function sight() {
    let { width, height } = fit();
    const dense = exact ? 1 : Math.min(devicePixelRatio || 1, 2) * coarse;
    width = exact ? camera.size[0] : Math.max(1, Math.round(width * dense));
    height = exact ? camera.size[1] : Math.max(1, Math.round(height * dense));
    const scale = Math.min(width / camera.size[0], height / camera.size[1]);
    return {
        rows: camera.rows, eye: camera.eye, near: camera.near, size: [width, height],
        focal: camera.focal.map((f) => f * scale),
        principal: camera.principal.map((p, k) => (p - camera.size[k] / 2) * scale + [width, height][k] / 2),
    };
}
let current; // camera parameters by which the workers sorted the Gaussians
function draw() {
    const { canvas } = painter.gl, [width, height] = current.size;
    const wide = mode() === "beside" ? 2 * width : width;
    if (canvas.width !== wide || canvas.height !== height) Object.assign(canvas, { width: wide, height });
    const images = seen().map((place) => painter.paint(models[place].figure, place, current, stage.background));
    const [a, b = a] = images;
    if (mode() === "beside") {
        painter.put(a, a, 0, width, 0);
        painter.put(b, b, width, width, 0);
    } else painter.put(a, b, 0, mode() === "wipe" ? cut * width : width, mode() === "difference" ? Number(el("gain").value) : 0);
}

async function refresh() {
    isBusy = true;
    isDirty = false;
    // If the frame at this time has not arrived yet, the last frame that has arrived is shown instead.
    const until = Math.min(...seen().map((place) => models[place].until));
    if (until > -Infinity) {
        const at = Math.min(time, until), from = sight(), isWhole = exact || coarse === 1;
        await Promise.all(seen().map((place) => models[place].show(at, from)));
        current = from;
        draw();
        await painter.finished();
        el("poster")?.remove();
        el("outside").hidden = !isOutside();
        rate();
        if (isWhole && !isDirty && !playing && arrivals()) {
            isDirty = false;
            document.documentElement.dataset.shown = location.hash;
            waiting.splice(0).forEach((resolve) => resolve());
        }
    }
    isBusy = false;
}

/// Shows the number of frames drawn per second. If it is low, reduces the resolution while something moves.
function rate() {
    const now = performance.now();
    // A still image needs no speed.
    drawn = now - moved < 1000 ? [...drawn.filter((t) => now - t < 8000).slice(-8), now] : [];
    const gaps = drawn.length - 1, mean = (now - drawn[0]) / gaps;
    if (gaps > 1) el("rate").textContent = `${(1000 / mean).toFixed(mean > 100 ? 1 : 0)} fps`;
    if (gaps > 1 && mean > 90 && coarse > 0.25 && !exact) {
        coarse = Math.max(0.25, coarse * Math.sqrt(60 / mean));
        drawn = [];
    }
}

let before = 0;
function tick(now) {
    requestAnimationFrame(tick);
    const passed = Math.min(now - before, 250) / 1000;
    before = now;
    const until = Math.min(...models.map((model) => model.until));
    if (playing && until > -Infinity && span[1] > span[0]) {
        const frames = Math.max(...models.map((model) => model.track.times.length));
        time += passed * Number(el("speed").value) * FRAMES_PER_SECOND * (span[1] - span[0]) / (frames - 1);
        if (time > until) time = until < span[1] ? until : span[0];
        moved = now;
        clock();
        isDirty = true;
    }
    if (coarse < 1 && now - moved > 400) {
        coarse = 1;
        isDirty = true;
    }
    if (isDirty && !isBusy) refresh().catch(fail);
}

// Controls.

function clock() {
    const model = models.reduce((a, b) => b.track.times.length > a.track.times.length ? b : a);
    const after = model.track.times.findIndex((t) => t > time + 1e-9 * (span[1] - span[0]));
    const frame = after < 0 ? model.track.times.length : after;
    el("scrub").value = time;
    el("now").textContent = `${frame}/${model.track.times.length} · t ${Number(time.toPrecision(3))}`;
}
function seek(to) {
    time = Math.max(span[0], Math.min(span[1], to));
    moved = performance.now();
    clock();
    isDirty = true;
}
function step(by) {
    const { times } = models.reduce((a, b) => b.track.times.length > a.track.times.length ? b : a).track;
    const slack = 1e-9 * (span[1] - span[0]);
    const next = by > 0 ? times.find((t) => t > time + slack) : times.findLast((t) => t < time - slack);
    play(false);
    if (next !== undefined) seek(next);
}
function play(on) {
    playing = on && span[1] > span[0];
    drawn = [];
    document.documentElement.classList.toggle("playing", playing);
    el("play").setAttribute("aria-label", playing ? "Pause" : "Play");
    isDirty = true;
}
function setCut(to) {
    cut = Math.max(0, Math.min(1, to));
    el("cut").style.left = `${100 * cut}%`;
    el("cut").setAttribute("aria-valuenow", Math.round(100 * cut));
    isDirty = true;
}
function jump(value) {
    const look = stage.cameras[value];
    lookFrom(look ?? home);
    if (look?.time != null) seek(look.time);
    el("camera").value = value;
}
function layOut() {
    const both = ["wipe", "beside", "difference"].includes(mode());
    el("gain").hidden = mode() !== "difference";
    el("cut").hidden = mode() !== "wipe";
    const label = (id, model) => {
        el(id).replaceChildren();
        if (!model) return;
        const { track } = model, less = [];
        if (track.times.length < model.frames) less.push(`${track.times.length} of ${model.frames} frames`);
        if (track.sh_degree < model.degree) less.push(`SH degree ${track.sh_degree} of ${model.degree}`);
        const small = document.createElement("small");
        small.textContent = [`${count(track.count)} Gaussians`, bytes(model.bytes), ...less].join(" · ");
        el(id).append(models.length > 1 ? model.role : model.name, small);
    };
    label("left", both ? models[0] : models[seen()[0]]);
    label("right", both && models[1]);
    isDirty = true;
}

function setUp() {
    document.title = models.map((model) => model.name).join(" → ") + " – splatsieve";
    el("show").hidden = models.length < 2;
    el("timing").hidden = el("speed").hidden = span[1] <= span[0];
    el("full").hidden = !document.fullscreenEnabled;
    Object.assign(el("scrub"), { min: span[0], max: span[1] });
    el("camera").append(new Option("Free camera", ""), ...stage.cameras.map((look, k) =>
        new Option(`View ${look.view} · ${look.split}${look.time == null ? "" : ` · t ${Number(look.time.toPrecision(3))}`}`, k)));
    home = stage.cameras[0] ?? overview();
    jump(stage.cameras.length ? 0 : "");
    setCut(0.5);
    facts();
    layOut();
    clock();
    listen();
    play(!matchMedia("(prefers-reduced-motion: reduce)").matches);
    addEventListener("hashchange", obey);
    obey();
}

/// Applies the settings #camera=VIEW&time=T&frame=K&show=MODE&cut=PART&paused&exact of a link. With exact, an image has the pixels
/// of the camera.
/// With ?embed or #embed the page shows the scene without controls.
function obey() {
    const asked = new URLSearchParams(location.hash.slice(1));
    const isEmbedded = asked.has("embed") || new URLSearchParams(location.search).has("embed");
    document.documentElement.classList.toggle("embed", isEmbedded);
    if (asked.has("show")) el("show").value = asked.get("show");
    if (asked.has("cut")) setCut(Number(asked.get("cut")));
    if (asked.has("camera")) {
        const place = stage.cameras.findIndex((look) => String(look.view) === asked.get("camera"));
        if (place >= 0) jump(place);
    }
    if (asked.has("frame")) seek(models.at(-1).track.times[Number(asked.get("frame"))] ?? time);
    if (asked.has("time")) seek(Number(asked.get("time")));
    if (asked.has("paused")) play(false);
    exact = asked.has("exact");
    document.documentElement.classList.toggle("exact", exact);
    layOut();
}

/// Returns a number with one significant digit.
const about = (x) => x < 1e-6 ? x.toExponential(0) : String(Number(x.toPrecision(1)));

const KEYS = [
    ["space", "play or pause"], [", .", "one frame back or on"], ["[ ]", "slower or faster"], ["arrows", "turn; with shift: move"],
    ["+ −", "closer or further away"], ["c C", "next or previous camera"], ["v", "next way to compare"], ["0", "back to the first camera"],
    ["f", "full screen"], ["?", "this help"],
];

/// Fills the help: keys, gestures and facts about the models.
function facts() {
    const list = document.createElement("dl");
    const fact = (term, text) => {
        const [dt, dd] = [document.createElement("dt"), document.createElement("dd")];
        dt.append(term);
        dd.textContent = text;
        list.append(dt, dd);
    };
    for (const [key, text] of KEYS) {
        const kbd = document.createElement("kbd");
        kbd.textContent = key;
        fact(kbd, text);
    }
    fact("Mouse", "drag to turn, right or shift drag to move, wheel to come closer");
    fact("Touch", "one finger turns, two fingers move and pinch");
    for (const { role, name, track, bytes: size, frames, degree } of models) {
        fact(role[0].toUpperCase() + role.slice(1), `${name}: ${count(track.count)} Gaussians, ${bytes(size)}; `
            + `${track.times.length} of ${frames} frames, SH degree ${track.sh_degree} of ${degree}`);
    }
    const { steps } = models[0].track, part = about(50 * steps.position / stage.extent);
    fact("Rounding here", `at most ${part}% of the scene's size in positions, ${about(steps.rotation / 2)} in unit quaternions, `
        + `${about(100 * Math.expm1(steps.log_scale / 2))}% in scales, ${about(steps.opacity / 2)} in opacities, `
        + `${about(steps.sh / 2)} in SH coefficients; between frames the values change evenly`);
    fact("Made by", stage.tool);
    el("facts").replaceChildren(list);
}

/// Enters or leaves full screen.
function toggleFull() {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen().catch(() => {});
}

function listen() {
    const canvas = el("canvas"), fingers = new Map();
    const middle = () => {
        const all = [...fingers.values()];
        const at = [0, 1].map((k) => all.reduce((sum, point) => sum + point[k], 0) / all.length);
        return { at, apart: all.length > 1 ? Math.hypot(all[0][0] - all[1][0], all[0][1] - all[1][1]) : 0 };
    };
    canvas.addEventListener("pointerdown", (event) => {
        canvas.setPointerCapture(event.pointerId);
        fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => {
        if (!fingers.has(event.pointerId)) return;
        const old = middle();
        fingers.set(event.pointerId, [event.clientX, event.clientY]);
        const now = middle(), across = now.at[0] - old.at[0], down = now.at[1] - old.at[1];
        if (fingers.size > 1 || event.buttons & 6 || event.shiftKey) pan(across, down);
        else orbit(across * 0.006, down * 0.006);
        if (old.apart > 0 && now.apart > 0) zoom(old.apart / now.apart);
    });
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
        event.preventDefault();
        zoom(Math.exp(Math.max(-0.5, Math.min(0.5, event.deltaY * (event.deltaMode ? 0.05 : 0.0015)))));
    }, { passive: false });
    canvas.addEventListener("webglcontextlost", () => fail("The graphics card was taken away; load the page again."));

    const handle = el("cut");
    const drag = (event) => {
        const box = el("stage").getBoundingClientRect();
        setCut((event.clientX - box.left) / box.width);
    };
    handle.addEventListener("pointerdown", (event) => {
        handle.setPointerCapture(event.pointerId);
        handle.onpointermove = drag;
    });
    handle.addEventListener("pointerup", () => { handle.onpointermove = null; });

    el("ask").onclick = () => el("help").showModal();
    el("close").onclick = () => el("help").close();
    el("full").onclick = toggleFull;
    el("play").onclick = () => play(!playing);
    el("scrub").oninput = () => { play(false); seek(Number(el("scrub").value)); };
    el("show").onchange = layOut;
    el("gain").onchange = layOut;
    el("camera").onchange = () => el("camera").value !== "" && jump(el("camera").value);
    new ResizeObserver(() => { isDirty = true; }).observe(el("stage"));
    addEventListener("keydown", (event) => {
        if (event.ctrlKey || event.metaKey || event.altKey || el("help").open || /SELECT|INPUT/.test(event.target.tagName)) return;
        const next = (select, by) => {
            select.selectedIndex = (select.selectedIndex + by + select.options.length) % select.options.length;
            select.dispatchEvent(new Event("change"));
        };
        const move = (x, y) => {
            if (event.target === handle && y === 0) setCut(cut + 0.01 * x);
            else if (event.shiftKey) pan(-20 * x, -20 * y);
            else orbit(-0.06 * x, -0.06 * y);
        };
        const speed = (by) => {
            const select = el("speed");
            select.selectedIndex = Math.max(0, Math.min(select.options.length - 1, select.selectedIndex + by));
        };
        const keys = {
            " ": () => event.target.tagName === "BUTTON" ? false : play(!playing),
            ",": () => step(-1), ".": () => step(1), "[": () => speed(-1), "]": () => speed(1),
            ArrowLeft: () => move(-1, 0), ArrowRight: () => move(1, 0), ArrowUp: () => move(0, -1), ArrowDown: () => move(0, 1),
            "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1 / 0.9),
            c: () => next(el("camera"), 1), C: () => next(el("camera"), -1), v: () => models.length > 1 && next(el("show"), 1),
            0: () => jump(stage.cameras.length ? 0 : ""), f: toggleFull, "?": () => el("help").showModal(),
        };
        if (!keys[event.key] || keys[event.key]() === false) return;
        event.preventDefault();
    });
}
