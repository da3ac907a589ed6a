// Draws models with WebGL 2. A first pass projects every Gaussian, a second blends their rectangles back to front into an image of
// half floats, and a third copies images to the canvas.

const TEXELS = 2048; // Gaussians across a texture, as in the worker

class Painter {
    constructor(canvas) {
        const gl = this.gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
        if (!gl) throw new Error("This browser does not offer WebGL 2, with which the scene is drawn.");
        // Many faint layers add up, which eight bits would lose.
        const floats = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
        this.format = floats ? gl.RGBA16F : gl.RGBA8;
        this.splat = this.program("quad", "splat");
        this.compose = this.program("cover", "compose");
        this.nothing = gl.createVertexArray();
        this.images = [];
    }

    program(vertex, fragment, defines = "") {
        const gl = this.gl, program = gl.createProgram();
        for (const [kind, name] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
            const shader = gl.createShader(kind);
            gl.shaderSource(shader, SHADERS[name].replace("\n", "\n" + defines));
            gl.compileShader(shader);
            if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
                throw new Error(`${name}: ${gl.getShaderInfoLog(shader)}`);
            }
            gl.attachShader(program, shader);
        }
        gl.linkProgram(program);
        if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(program));
        const at = {};
        for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
            const { name } = gl.getActiveUniform(program, k);
            at[name] = gl.getUniformLocation(program, name);
        }
        return { program, at };
    }

    texture(kind = this.gl.TEXTURE_2D) {
        const gl = this.gl, texture = gl.createTexture();
        gl.bindTexture(kind, texture);
        for (const [name, value] of [
            [gl.TEXTURE_MIN_FILTER, gl.NEAREST], [gl.TEXTURE_MAG_FILTER, gl.NEAREST],
            [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
        ]) gl.texParameteri(kind, name, value);
        return texture;
    }

    target(textures) {
        const gl = this.gl, framebuffer = gl.createFramebuffer();
        gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
        textures.forEach((texture, k) => gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, texture, 0));
        gl.drawBuffers(textures.map((_, k) => gl.COLOR_ATTACHMENT0 + k));
        return framebuffer;
    }

    /// Binds textures to samplers. `textures`: for each name of a sampler, the texture and its kind.
    bind(at, textures) {
        Object.entries(textures).forEach(([name, [texture, kind]], unit) => {
            this.gl.activeTexture(this.gl.TEXTURE0 + unit);
            this.gl.bindTexture(kind ?? this.gl.TEXTURE_2D, texture);
            this.gl.uniform1i(at[name], unit);
        });
    }

    /// Returns image `place` (texture and framebuffer). Makes it anew if it does not have this size.
    image(place, width, height) {
        const gl = this.gl;
        let image = this.images[place];
        if (image?.width !== width || image?.height !== height) {
            if (image) {
                gl.deleteTexture(image.texture);
                gl.deleteFramebuffer(image.target);
            }
            const texture = this.texture();
            gl.texStorage2D(gl.TEXTURE_2D, 1, this.format, width, height);
            image = this.images[place] = { texture, target: this.target([texture]), width, height };
        }
        return image;
    }

    /// Draws `figure` from the camera `sight` into image `place`.
    paint(figure, place, sight, background) {
        const gl = this.gl, [width, height] = sight.size;
        figure.project(sight);
        const image = this.image(place, width, height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, image.target);
        gl.viewport(0, 0, width, height);
        gl.clearColor(...background, 1);
        gl.clear(gl.COLOR_BUFFER_BIT);
        const { program, at } = this.splat;
        gl.useProgram(program);
        this.bind(at, { form: [figure.form], reach: [figure.reach], colour: [figure.colour] });
        gl.uniform2f(at.size, width, height);
        gl.enable(gl.BLEND);
        gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
        gl.bindVertexArray(figure.order);
        gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, figure.visible);
        gl.disable(gl.BLEND);
        return image;
    }

    /// Resolves when all requested frames are drawn, so that requests do not pile up on a slow machine.
    finished() {
        const gl = this.gl, sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
        gl.flush();
        return new Promise((resolve) => {
            const look = () => {
                if (gl.clientWaitSync(sync, 0, 0) === gl.TIMEOUT_EXPIRED) return setTimeout(look, 3);
                gl.deleteSync(sync);
                resolve();
            };
            setTimeout(look);
        });
    }

    /// Draws two images in one place of the canvas, from its column `x` on: `left` in their columns before `cut`, `right` in the
    /// others. If `gain` is above 0, draws their difference times `gain` instead.
    put(left, right, x, cut, gain) {
        const gl = this.gl, { program, at } = this.compose;
        gl.bindFramebuffer(gl.FRAMEBUFFER, null);
        gl.viewport(x, 0, left.width, left.height);
        gl.useProgram(program);
        this.bind(at, { left: [left.texture], right: [right.texture] });
        gl.uniform2f(at.corner, x, 0);
        gl.uniform1f(at.cut, cut);
        gl.uniform1f(at.gain, gain);
        gl.bindVertexArray(this.nothing);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
}

/// Model on the graphics card.
class Figure {
    constructor(painter, track) {
        const gl = painter.gl;
        Object.assign(this, { painter, track, visible: 0, rows: Math.max(1, Math.ceil(track.count / TEXELS)) });
        if (this.rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error(`${track.count} Gaussians are too many for this graphics card.`);
        this.layers = Math.ceil(3 * (track.sh_degree + 1) ** 2 / 4);
        this.program = painter.program("cover", "project", `#define DEGREE ${track.sh_degree}\n#define LAYERS ${this.layers}\n`);
        for (const name of ["place", "turn", "extent"]) {
            this[name] = painter.texture();
            gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, TEXELS, this.rows);
        }
        this.harmonics = painter.texture(gl.TEXTURE_2D_ARRAY);
        gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA16I, TEXELS, this.rows, this.layers);
        for (const name of ["form", "reach", "colour"]) {
            this[name] = painter.texture();
            gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, TEXELS, this.rows);
        }
        this.target = painter.target([this.form, this.reach, this.colour]);
        this.ids = gl.createBuffer();
        this.order = gl.createVertexArray();
        gl.bindVertexArray(this.order);
        gl.bindBuffer(gl.ARRAY_BUFFER, this.ids);
        gl.enableVertexAttribArray(0);
        gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
        gl.vertexAttribDivisor(0, 1);
    }

    /// Copies an answer of the worker to the graphics card: the attributes that changed, and the order of the Gaussians.
    take(message) {
        const gl = this.painter.gl;
        for (const name of ["place", "turn", "extent"]) {
            if (!message[name]) continue;
            gl.bindTexture(gl.TEXTURE_2D, this[name]);
            gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXELS, this.rows, gl.RGBA, gl.FLOAT, message[name]);
        }
        if (message.harmonics) {
            gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.harmonics);
            gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, 0, TEXELS, this.rows, this.layers, gl.RGBA_INTEGER, gl.SHORT, message.harmonics);
        }
        gl.bindBuffer(gl.ARRAY_BUFFER, this.ids);
        gl.bufferData(gl.ARRAY_BUFFER, message.order, gl.DYNAMIC_DRAW);
        this.visible = message.order.length;
    }

    /// Computes the footprints of all Gaussians on the screen, for the given camera.
    project({ rows, eye, focal, principal, size, near }) {
        const { painter, track } = this, gl = painter.gl, { program, at } = this.program;
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
        gl.viewport(0, 0, TEXELS, this.rows);
        gl.useProgram(program);
        painter.bind(at, {
            place: [this.place], turn: [this.turn], extent: [this.extent], harmonics: [this.harmonics, gl.TEXTURE_2D_ARRAY],
        });
        gl.uniform1f(at.harmonicStep, track.steps.sh);
        gl.uniformMatrix3fv(at.rows, false, rows.flat());
        gl.uniform3fv(at.eye, eye);
        gl.uniform2fv(at.focal, focal);
        gl.uniform2f(at.principal, principal[0] - 0.5, principal[1] - 0.5);
        gl.uniform2f(at.slopeLimit, 0.65 * size[0] / focal[0], 0.65 * size[1] / focal[1]);
        gl.uniform2fv(at.size, size);
        gl.uniform1f(at.near, near);
        gl.bindVertexArray(painter.nothing);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
}
