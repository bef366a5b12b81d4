// Cameras: exact ones of the photos, and a free one. World axes are the scene's own (COLMAP's).
const NEAR = 0.01; // as in training

/** Where a photo of this size lies in a pane: scale and offsets in CSS px. */
function fitted(view, width, height) {
  const scale = Math.min(width / view.width, height / view.height);
  return { scale, left: (width - scale * view.width) / 2, top: (height - scale * view.height) / 2 };
}

/** The pose and projection of a photo's camera in a pane: the whole photo is in it, and what lies beside it. */
function lookThrough(T, camera, view, width, height) {
  const { scale, left, top } = fitted(view, width, height);
  const far = 1000 * DATA.extent + 100;
  const x = NEAR / (view.fx * scale), y = NEAR / (view.fy * scale);
  const cx = view.cx * scale + left, cy = view.cy * scale + top;
  camera.projectionMatrix.makePerspective(-cx * x, (width - cx) * x, cy * y, -(height - cy) * y, NEAR, far);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  const seen = new T.Matrix4().set(...view.cam_from_world);
  seen.premultiply(new T.Matrix4().makeScale(1, -1, -1)); // OpenCV's axes to OpenGL's
  seen.invert().decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
}

/** Least and largest x / z, then y / z (y up) of the rays that shapes are projected along; as in training. */
function rayLimits(view) {
  const x = (0.15 * view.width) / view.fx, y = (0.15 * view.height) / view.fy;
  return [
    -view.cx / view.fx - x, -(view.height - view.cy) / view.fy - y,
    (view.width - view.cx) / view.fx + x, view.cy / view.fy + y,
  ];
}

/** The free camera's projection: as wide as the photo that was looked through last. */
function freeProjection(camera, width, height) {
  const view = DATA.views[state.lens ?? 0];
  const { scale } = fitted(view, width, height);
  camera.fov = (2 * Math.atan(height / scale / 2 / view.fy) * 180) / Math.PI;
  camera.aspect = width / height;
  camera.near = NEAR;
  camera.far = 1000 * DATA.extent + 100;
  camera.updateProjectionMatrix();
}

/** The camera as nerfstudio and `aw video` read it: row by row, OpenGL's axes, the vertical angle of view. */
function pathEntry(camera) {
  const m = camera.matrixWorld.elements;
  const rows = [0, 1, 2, 3].flatMap((row) => [0, 1, 2, 3].map((column) => m[4 * column + row]));
  DATA.centre.forEach((value, axis) => { rows[4 * axis + 3] = rows[4 * axis + 3] / DATA.scale + value; });
  const fov = (2 * Math.atan(1 / camera.projectionMatrix.elements[5]) * 180) / Math.PI;
  return { camera_to_world: rows, fov, aspect: camera.projectionMatrix.elements[5] / camera.projectionMatrix.elements[0] };
}

const pathFile = () => ({ camera_type: "perspective", camera_path: state.path });

const savePath = () => save("path.json", new Blob([JSON.stringify(pathFile())], { type: "application/json" }));

/** A pyramid of lines for each camera, with its photo at the end. */
function makeFrusta(T, views, size) {
  const group = new T.Group();
  for (const [index, view] of views.entries()) {
    const x = [-view.cx / view.fx, (view.width - view.cx) / view.fx];
    const y = [-view.cy / view.fy, (view.height - view.cy) / view.fy];
    const corners = [[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]].map(([a, b]) => [a * size, b * size, size]);
    const lines = corners.flatMap((corner, k) => [[0, 0, 0], corner, corner, corners[(k + 1) % 4]]).flat();
    const frustum = new T.Group();
    const colour = view.split === "test" ? 0xffa640 : 0x58a6ff;
    const geometry = new T.BufferGeometry().setAttribute("position", new T.Float32BufferAttribute(lines, 3));
    frustum.add(new T.LineSegments(geometry, new T.LineBasicMaterial({ color: colour, toneMapped: false })));
    const quad = new T.BufferGeometry().setAttribute("position", new T.Float32BufferAttribute(corners.flat(), 3));
    quad.setAttribute("uv", new T.Float32BufferAttribute([0, 1, 1, 1, 1, 0, 0, 0], 2));
    quad.setIndex([0, 1, 2, 0, 2, 3]);
    const face = new T.Mesh(quad, new T.MeshBasicMaterial({ color: 0x888888, side: T.DoubleSide, toneMapped: false }));
    face.userData.view = index;
    frustum.add(face);
    frustum.matrixAutoUpdate = false;
    frustum.matrix.set(...view.cam_from_world).invert();
    group.add(frustum);
  }
  return group;
}

/** Small photos on the faces; asked for when the cameras are first shown. */
async function paintFrusta(T, group, views, done) {
  for (const [index, view] of views.entries()) {
    const photo = await image(view.photo);
    const width = Math.min(128, photo.naturalWidth);
    const canvas = h("canvas");
    canvas.width = width;
    canvas.height = Math.max(1, Math.round((width * photo.naturalHeight) / photo.naturalWidth));
    canvas.getContext("2d").drawImage(photo, 0, 0, canvas.width, canvas.height);
    const texture = new T.CanvasTexture(canvas);
    texture.colorSpace = T.SRGBColorSpace;
    const material = group.children[index].children[1].material;
    material.color.set(0xffffff);
    material.map = texture;
    material.needsUpdate = true;
  }
  done();
}
