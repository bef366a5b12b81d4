// A pane draws one model, or shows the photo of the camera that is looked through.
const PIXEL_RATIO = Math.min(window.devicePixelRatio || 1, matchMedia("(pointer: coarse)").matches ? 1.5 : 2);

/**
 * Spark projects a Gaussian's shape along its own ray. In training the ray is kept within the picture and 15 % of it
 * on each side (3DGS), which decides how large Gaussians look that lie beside the picture: here it is the same.
 */
const RAY = "vec2 J2 = -(J1 * viewCenter.xy) * invZ;";
const KEPT_RAY = "vec2 J2 = J1 * clamp(-viewCenter.xy * invZ, rayLimits.xy, rayLimits.zw);";

function keepRays(spark, limits) {
  const { material } = spark;
  if (!material.vertexShader.includes(RAY)) throw new Error("the shader of this Spark is another one");
  material.vertexShader = material.vertexShader.replace(RAY, KEPT_RAY).replace("void main() {", "uniform vec4 rayLimits;\nvoid main() {");
  material.uniforms.rayLimits = { value: limits };
  material.needsUpdate = true;
}

class Pane {
  constructor(R, element, dirty) {
    this.R = R;
    this.element = element;
    this.dirty = dirty;
    this.label = element.appendChild(h("span"));
    this.photo = element.appendChild(h("canvas", { class: "still" }));
    this.photo.hidden = true;
    this.showing = null;
  }

  /** The renderer is made when the pane first draws a model: a phone pays for one as long as one is enough. */
  prepare() {
    if (this.renderer) return;
    const { THREE: T, SparkRenderer } = this.R;
    this.canvas = h("canvas");
    this.element.prepend(this.canvas);
    this.renderer = new T.WebGLRenderer({ canvas: this.canvas, antialias: false, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(PIXEL_RATIO);
    this.scene = new T.Scene();
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      sortRadial: false, // by depth, as in training
      maxStdDev: 3.33, // where an opaque Gaussian falls below 1/255
      minAlpha: 1 / 255,
      maxPixelRadius: 4096,
      clipXY: 4,
      accumExtSplats: true,
      enableLod: false,
      onDirty: this.dirty,
    });
    this.scene.add(this.spark);
    this.limits = new T.Vector4();
    keepRays(this.spark, this.limits);
    this.frusta = makeFrusta(T, DATA.views, DATA.frustum);
    this.frusta.visible = false;
    this.scene.add(this.frusta);
  }

  async show(choice) {
    const model = choice === PHOTO ? null : DATA.models[choice];
    this.label.textContent = model ? model.label : "photo";
    this.photo.hidden = choice !== PHOTO;
    this.element.style.background = model ? "" : "#000"; // the other model does not go on beside the photo
    this.choice = choice;
    if (this.canvas) this.canvas.style.visibility = model ? "visible" : "hidden";
    if (!model || this.showing === choice) return;
    this.prepare();
    this.canvas.style.visibility = "visible";
    const { SplatMesh } = this.R;
    const mesh = new SplatMesh({ fileBytes: bytesOf(model.element), fileName: "model.spz", extSplats: true, lod: false });
    mesh.quaternion.set(1, 0, 0, 0); // SPZ has y up and z back; the scene y down and z forward
    await mesh.initialized;
    if (this.choice !== choice) return mesh.dispose();
    if (this.mesh) {
      this.scene.remove(this.mesh);
      this.mesh.dispose();
    }
    this.mesh = mesh;
    this.showing = choice;
    this.drawn = false;
    this.spark.preBlurAmount = model.antialias ? 0 : model.blur;
    this.spark.blurAmount = model.antialias ? model.blur : 0;
    this.renderer.setClearColor(new this.R.THREE.Color().setRGB(...model.background, this.R.THREE.SRGBColorSpace), 1);
    this.scene.add(mesh);
  }

  draw(camera) {
    if (this.choice === PHOTO || !this.mesh) return;
    const width = this.element.clientWidth, height = this.element.clientHeight;
    const size = this.renderer.getSize(new this.R.THREE.Vector2());
    if (size.x !== width || size.y !== height) this.renderer.setSize(width, height, false);
    this.limits.set(...rayLimits(DATA.views[state.lens ?? 0]));
    this.frusta.visible = state.frusta;
    for (const [index, frustum] of this.frusta.children.entries()) frustum.visible = index !== state.view;
    this.renderer.render(this.scene, camera);
    const gl = this.renderer.getContext();
    gl.deleteSync(this.fence ?? null);
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.drawn = true;
  }

  /** Whether the chosen model is on the screen, its Gaussians sorted for this camera; without a GPU that takes seconds. */
  get settled() {
    if (this.choice === PHOTO) return true;
    const { spark, mesh } = this, gl = this.renderer?.getContext();
    if (this.showing !== this.choice || !this.drawn || (mesh.numSplats && !spark.activeSplats)) return false;
    if (spark.updateTimeoutId !== -1 || spark.sorting || spark.sortDirty) return false;
    return gl.getSyncParameter(this.fence, gl.SYNC_STATUS) === gl.SIGNALED;
  }

  /** The photo lies where the model's picture of it would. */
  async drawPhoto(view) {
    if (this.choice !== PHOTO) return;
    this.photo.style.visibility = view ? "visible" : "hidden";
    this.label.textContent = view ? "photo" : "photo: choose a camera";
    if (!view) return;
    await paintPhoto(this.photo, view);
    const { scale, left, top } = fitted(view, this.element.clientWidth, this.element.clientHeight);
    Object.assign(this.photo.style, { left: `${left}px`, top: `${top}px`, width: `${scale * view.width}px`, height: `${scale * view.height}px` });
  }
}
