// The surface in 3D. Triangles are drawn unindexed, so that a colour can belong to a face or to a corner.

import {
  AmbientLight,
  BufferAttribute,
  BufferGeometry,
  DirectionalLight,
  DoubleSide,
  Mesh,
  MeshLambertMaterial,
  PerspectiveCamera,
  Raycaster,
  Scene,
  Sphere,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { paint } from "./colours.js";

export class Surface {
  /** @param {HTMLCanvasElement} canvas @param {(axes: number[][]) => void} onDraw called after each drawing with the directions of the axes */
  constructor(canvas, onDraw = () => {}) {
    this.canvas = canvas;
    this.onDraw = onDraw;
    // The drawing is preserved, so that it can be copied, and read by a test.
    this.renderer = new WebGLRenderer({ canvas, antialias: false, alpha: true, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(30, 1, 1, 10000);
    this.camera.up.set(0, 0, 1);
    this.scene.add(new AmbientLight(0xffffff, 2.2), this.camera);
    const lamp = new DirectionalLight(0xffffff, 1.1);
    lamp.position.set(0.4, 0.6, 1);
    this.camera.add(lamp);
    this.mesh = new Mesh(new BufferGeometry(), new MeshLambertMaterial({ vertexColors: true, side: DoubleSide }));
    this.mesh.frustumCulled = false;
    this.scene.add(this.mesh);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.listenToKeyEvents(canvas);
    this.controls.addEventListener("change", () => this.draw());
    new ResizeObserver(() => this.#resize()).observe(canvas);
    this.#resize();
  }

  /** The triangles of a run: vertex indices, Uint32Array (3 × faces). */
  setFaces(faces) {
    this.faces = faces;
    this.points = null;
    this.mesh.geometry.dispose();
    const geometry = new BufferGeometry();
    for (const name of ["position", "normal", "color"]) {
      geometry.setAttribute(name, new BufferAttribute(new Float32Array(3 * faces.length), 3));
    }
    this.mesh.geometry = geometry;
  }

  /** Vertices of one step, Float32Array (3 × points) in mm, NaN where not measured: such faces are not drawn. */
  setPositions(points) {
    const { faces } = this;
    if (points === this.points) return;
    this.points = points;
    const normals = vertexNormals(points, faces);
    const position = this.mesh.geometry.attributes.position;
    const normal = this.mesh.geometry.attributes.normal;
    this.drawn = new Uint32Array(faces.length / 3);
    let count = 0;
    for (let face = 0; face < faces.length / 3; face++) {
      const corners = faces.subarray(3 * face, 3 * face + 3);
      if (!corners.every((corner) => Number.isFinite(points[3 * corner]))) continue;
      for (let k = 0; k < 3; k++) {
        const from = 3 * corners[k];
        position.array.set(points.subarray(from, from + 3), 9 * count + 3 * k);
        normal.array.set(normals.subarray(from, from + 3), 9 * count + 3 * k);
      }
      this.drawn[count++] = face;
    }
    this.count = count;
    this.mesh.geometry.setDrawRange(0, 3 * count);
    this.mesh.geometry.boundingSphere = boundingSphere(position.array, 9 * count);
    position.needsUpdate = true;
    normal.needsUpdate = true;
  }

  /** Colours by a field, Float32Array with a value a face or a point. */
  setField(values, location, scale, low, high) {
    this.values = values;
    this.location = location;
    const colour = this.mesh.geometry.attributes.color;
    for (let i = 0; i < this.count; i++) {
      const face = this.drawn[i];
      for (let k = 0; k < 3; k++) {
        const value = location === "face" ? values[face] : values[this.faces[3 * face + k]];
        paint(scale, value, low, high, colour.array, 9 * i + 3 * k);
      }
    }
    colour.needsUpdate = true;
    this.draw();
  }

  /** View the whole surface from the side that it faces, a little from above; a closed one from a fixed side. */
  resetView() {
    const sphere = this.mesh.geometry.boundingSphere;
    if (!sphere || !(sphere.radius > 0)) return;
    const opening = (this.camera.fov * Math.PI) / 360;
    const distance = (1.05 * sphere.radius) / Math.sin(Math.min(opening, Math.atan(Math.tan(opening) * this.camera.aspect)));
    const { direction: facing, share } = facingOf(this.mesh.geometry.attributes.position.array, 9 * this.count);
    const direction = share > 0.2 ? facing.setZ(0.2 + facing.z) : new Vector3(1, -0.55, 0.4);
    direction.normalize();
    this.camera.position.copy(sphere.center).addScaledVector(direction, distance);
    this.camera.near = distance / 100;
    this.camera.far = distance * 20;
    this.camera.updateProjectionMatrix();
    this.controls.target.copy(sphere.center);
    this.controls.update();
    this.draw();
  }

  /** The value under a point of the screen, or null: { value, position }. */
  pick(clientX, clientY) {
    if (!this.values) return null;
    const box = this.canvas.getBoundingClientRect();
    const at = new Vector2((2 * (clientX - box.left)) / box.width - 1, 1 - (2 * (clientY - box.top)) / box.height);
    const caster = new Raycaster();
    caster.setFromCamera(at, this.camera);
    const hit = caster.intersectObject(this.mesh)[0];
    if (!hit) return null;
    const face = this.drawn[hit.faceIndex];
    const corners = [...this.faces.subarray(3 * face, 3 * face + 3)];
    const value =
      this.location === "face"
        ? this.values[face]
        : corners.reduce((sum, corner) => sum + this.values[corner], 0) / 3;
    return { value, position: hit.point };
  }

  /** Where the world's axes point on the screen: [right, up, towards the eye] for x, y and z, unit vectors. */
  axes() {
    this.camera.updateMatrixWorld();
    const columns = this.camera.matrixWorldInverse.elements;
    return [0, 1, 2].map((k) => [columns[4 * k], columns[4 * k + 1], columns[4 * k + 2]]);
  }

  draw() {
    this.renderer.render(this.scene, this.camera);
    this.onDraw(this.axes());
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }
}

function boundingSphere(array, length) {
  const low = new Vector3(Infinity, Infinity, Infinity);
  const high = new Vector3(-Infinity, -Infinity, -Infinity);
  const point = new Vector3();
  for (let i = 0; i < length; i += 3) {
    point.fromArray(array, i);
    low.min(point);
    high.max(point);
  }
  if (!length) return new Sphere(new Vector3(), 0);
  return new Sphere(low.clone().add(high).multiplyScalar(0.5), low.distanceTo(high) / 2);
}

/** The mean direction of the triangles, weighted by area, and how much of the area agrees with it, 0 … 1. */
function facingOf(array, length) {
  const direction = new Vector3();
  const [a, b, c] = [new Vector3(), new Vector3(), new Vector3()];
  let area = 0;
  for (let i = 0; i < length; i += 9) {
    a.fromArray(array, i);
    b.fromArray(array, i + 3).sub(a);
    c.fromArray(array, i + 6).sub(a);
    b.cross(c);
    area += b.length();
    direction.add(b);
  }
  return { share: area ? direction.length() / area : 0, direction: direction.normalize() };
}

/** Normals of the vertices: the sum of the area vectors of the faces around them. */
function vertexNormals(points, faces) {
  const normals = new Float32Array(points.length);
  const [a, b, c, normal] = [new Vector3(), new Vector3(), new Vector3(), new Vector3()];
  for (let i = 0; i < faces.length; i += 3) {
    a.fromArray(points, 3 * faces[i]);
    b.fromArray(points, 3 * faces[i + 1]).sub(a);
    c.fromArray(points, 3 * faces[i + 2]).sub(a);
    normal.crossVectors(b, c);
    if (!Number.isFinite(normal.x)) continue;
    for (let k = 0; k < 3; k++) {
      const at = 3 * faces[i + k];
      normals[at] += normal.x;
      normals[at + 1] += normal.y;
      normals[at + 2] += normal.z;
    }
  }
  return normals;
}
