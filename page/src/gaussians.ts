// Gaussians on the GPU. Near ones are ellipsoids, a triangle each, which the fragment shader meets with the ray of its
// pixel, and whose corners read their Gaussian from a texture. Farther ones are discs along their two longest axes, a
// triangle each, whose corners are computed once. Far ones are round discs of the same area, a point each: a third of the
// corners. (Instances would say the same, but software GL draws each by itself, many times slower.)

import * as THREE from "three";
import { colourOf, type Shades } from "./colours";
import { METRES_PER_STEP, type Packed } from "./packed";

const FULL_M = 65535 * METRES_PER_STEP;
export const SIGMAS = 2.0;
export const FLASH_S = 2.5;

const ROW = 1024; // texels; two a Gaussian

const CORNER = /* glsl */ `
  vec2 corner() { // of a triangle around the unit circle
    int c = gl_VertexID % 3;
    return c == 0 ? vec2(-1.7320508, -1.0) : c == 1 ? vec2(1.7320508, -1.0) : vec2(0.0, 2.0);
  }
`;

const COMMON = /* glsl */ `
  uniform highp usampler2D uData; uniform float uTime; uniform float uFlashAt; uniform vec3 uFlash;
  struct Gaussian { vec3 mean; vec4 turn; vec3 reach; vec3 colour; };
  ${CORNER}
  Gaussian own() {
    int at = (gl_VertexID / 3) * 2;
    ivec2 texel = ivec2(at % ${ROW}, at / ${ROW});
    uvec4 a = texelFetch(uData, texel, 0), b = texelFetch(uData, texel + ivec2(1, 0), 0);
    vec4 colour = vec4(uvec4(a.w, a.w >> 8, a.w >> 16, a.w >> 24) & 255u) / 255.0;
    float glow = colour.a > 0.5 ? clamp(1.0 - (uTime - uFlashAt) / ${FLASH_S.toFixed(1)}, 0.0, 1.0) : 0.0;
    vec3 sd = vec3(unpackUnorm2x16(b.z), unpackUnorm2x16(b.w).x) * ${FULL_M.toFixed(5)};
    return Gaussian(
      uintBitsToFloat(a.xyz),
      vec4(unpackSnorm2x16(b.x), unpackSnorm2x16(b.y)),
      max(sd * ${SIGMAS.toFixed(1)}, vec3(0.05, 0.05, 0.02)),
      mix(colour.rgb, uFlash, glow * 0.85));
  }
  mat3 axes(vec4 raw) {
    vec4 q = raw / length(raw);
    vec3 x = q.xyz + q.xyz; vec3 d = q.xyz * x; vec3 w = q.w * x;
    float xy = q.x * x.y, xz = q.x * x.z, yz = q.y * x.z;
    return mat3(1.0 - d.y - d.z, xy + w.z, xz - w.y,
                xy - w.z, 1.0 - d.x - d.z, yz + w.x,
                xz + w.y, yz - w.x, 1.0 - d.x - d.y);
  }
`;

const LIGHT = /* glsl */ `
  vec3 shaded(vec3 colour, vec3 n) {
    float light = 0.58 + 0.30 * max(dot(n, normalize(vec3(0.25, 0.55, 0.8))), 0.0) + 0.14 * max(n.y, 0.0);
    return colour * light;
  }
`;

const SHADE = /* glsl */ `
  uniform float uGhost;
  void stipple() {
    if (uGhost > 0.0 && mod(floor(gl_FragCoord.x) + floor(gl_FragCoord.y), 2.0) > 0.5) discard;
  }
`;

const DISC_VERTEX = /* glsl */ `
  in vec3 aNormal; in vec4 aColour;
  uniform float uTime; uniform float uFlashAt; uniform vec3 uFlash;
  out vec2 vCorner; flat out vec3 vColour;
  ${CORNER}
  ${LIGHT}
  void main() {
    vec4 at = modelViewMatrix * vec4(position, 1.0);
    vec3 n = mat3(modelViewMatrix) * aNormal;
    float glow = aColour.a > 0.5 ? clamp(1.0 - (uTime - uFlashAt) / ${FLASH_S.toFixed(1)}, 0.0, 1.0) : 0.0;
    vCorner = corner();
    vColour = shaded(mix(aColour.rgb, uFlash, glow * 0.85), dot(n, at.xyz) > 0.0 ? -n : n);
    gl_Position = projectionMatrix * at;
  }
`;

const DISC_FRAGMENT = /* glsl */ `
  ${SHADE}
  in vec2 vCorner; flat in vec3 vColour;
  out vec4 pixel;
  void main() {
    if (dot(vCorner, vCorner) > 1.0) discard;
    stipple();
    pixel = vec4(vColour, 1.0);
  }
`;

const POINT_VERTEX = /* glsl */ `
  in vec4 aNormal; in vec4 aColour; in float aReach;
  uniform float uTime; uniform float uFlashAt; uniform vec3 uFlash; uniform float uFocal;
  flat out vec3 vAcross; flat out vec3 vColour;
  ${LIGHT}
  void main() {
    vec4 at = modelViewMatrix * vec4(position, 1.0);
    vec3 n = mat3(modelViewMatrix) * aNormal.xyz;
    float slant = dot(n, normalize(at.xyz)), r = 1.12 * uFocal * aReach / -at.z; // no seams
    float glow = aColour.a > 0.5 ? clamp(1.0 - (uTime - uFlashAt) / ${FLASH_S.toFixed(1)}, 0.0, 1.0) : 0.0;
    vColour = shaded(mix(aColour.rgb, uFlash, glow * 0.85), slant > 0.0 ? -n : n);
    // Along the normal, as it lies on the screen, the disc is as much shorter as one looks at it askance.
    float flat2 = length(n.xy);
    vAcross = r < 1.2 || flat2 < 0.01 ? vec3(0.0) : vec3(n.xy / flat2, 1.0 / clamp(abs(slant), 0.8 / r, 1.0));
    gl_PointSize = clamp(2.0 * r, 1.5, 60.0);
    gl_Position = projectionMatrix * at;
  }
`;

const POINT_FRAGMENT = /* glsl */ `
  flat in vec3 vAcross; flat in vec3 vColour;
  out vec4 pixel;
  void main() {
    vec2 p = vec2(2.0, -2.0) * (gl_PointCoord - 0.5);
    float a = dot(p, vAcross.xy) * vAcross.z, b = dot(p, vec2(-vAcross.y, vAcross.x));
    if (a * a + b * b > 1.0) discard;
    pixel = vec4(vColour, 1.0);
  }
`;

const ELLIPSOID_VERTEX = /* glsl */ `
  ${COMMON}
  flat out float vDepth; out vec3 vRay; flat out vec3 vEye; flat out vec3 vColour; flat out mat3 vBack;
  void main() {
    Gaussian g = own();
    vec3 s = g.reach;
    mat3 V = mat3(modelViewMatrix) * axes(g.turn);
    mat3 M = mat3(V[0] * s.x, V[1] * s.y, V[2] * s.z);
    vec3 c = (modelViewMatrix * vec4(g.mean, 1.0)).xyz;
    // What the ellipsoid covers of the plane through its middle: an ellipse, as a map of the unit circle (Cholesky).
    vec2 slant = c.xy / c.z;
    vec3 p = vec3(M[0].x, M[1].x, M[2].x) - slant.x * vec3(M[0].z, M[1].z, M[2].z);
    vec3 q = vec3(M[0].y, M[1].y, M[2].y) - slant.y * vec3(M[0].z, M[1].z, M[2].z);
    float l = length(p), m = dot(p, q) / l, n = sqrt(max(dot(q, q) - m * m, 1e-8));
    float wide = s.x / length(c), grow = 1.02 * inversesqrt(max(1.0 - wide * wide, 0.1));
    vec2 at2 = corner() * grow;
    vec3 at = c + vec3(l * at2.x, m * at2.x + n * at2.y, 0.0);
    if (at.z > -0.05) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; }
    mat3 inverseM = transpose(mat3(V[0] / s.x, V[1] / s.y, V[2] / s.z));
    vBack = transpose(inverseM); vEye = inverseM * -c; vRay = inverseM * at; vDepth = at.z;
    vColour = g.colour;
    gl_Position = projectionMatrix * vec4(at, 1.0);
  }
`;

const ELLIPSOID_FRAGMENT = /* glsl */ `
  ${SHADE}
  ${LIGHT}
  uniform mat4 projectionMatrix;
  flat in float vDepth; in vec3 vRay; flat in vec3 vEye; flat in vec3 vColour; flat in mat3 vBack;
  out vec4 pixel;
  void main() {
    float a = dot(vRay, vRay), b = dot(vEye, vRay), c = dot(vEye, vEye) - 1.0;
    float inside = b * b - a * c;
    if (inside < 0.0) discard;
    float t = (-b - sqrt(inside)) / a;
    if (t <= 0.0) discard;
    stipple();
    vec3 n = normalize(vBack * (vEye + t * vRay));
    float z = t * vDepth;
    gl_FragDepth = 0.5 + 0.5 * (projectionMatrix[2].z * z + projectionMatrix[3].z) / -z;
    pixel = vec4(shaded(vColour, n), 1.0);
  }
`;

export interface Looks {
  point: THREE.ShaderMaterial;
  disc: THREE.ShaderMaterial;
  ellipsoid: THREE.ShaderMaterial;
  ghost: THREE.ShaderMaterial;
  /** `uFocal`: pixels that 1 m is high at a distance of 1 m. */
  uniforms: { uTime: { value: number }; uFlash: { value: THREE.Color }; uFocal: { value: number } };
}

export function looks(): Looks {
  const uniforms = { uTime: { value: 0 }, uFlash: { value: new THREE.Color(1, 1, 1) }, uFocal: { value: 800 } };
  const make = (vertexShader: string, fragmentShader: string, ghost: number) =>
    new THREE.ShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader,
      fragmentShader,
      uniforms: { ...uniforms, uGhost: { value: ghost }, uData: { value: null }, uFlashAt: { value: 0 } },
      side: THREE.DoubleSide,
    });
  return {
    point: make(POINT_VERTEX, POINT_FRAGMENT, 0),
    disc: make(DISC_VERTEX, DISC_FRAGMENT, 0),
    ellipsoid: make(ELLIPSOID_VERTEX, ELLIPSOID_FRAGMENT, 0),
    ghost: make(DISC_VERTEX, DISC_FRAGMENT, 1),
    uniforms,
  };
}

const [WEST, EAST] = [-Math.sqrt(3), Math.sqrt(3)];
const CORNERS = [WEST, -1, EAST, -1, 0, 2];
const FLASHES = 255;

type Kind = "points" | "discs" | "ellipsoids";

/** A version as the GPU has it, in each kind of drawing from when it is first needed. */
export class Drawable {
  flashAt = 0;
  private readonly colours: Uint8Array<ArrayBuffer>;
  private readonly made: Partial<Record<Kind, THREE.BufferGeometry>> = {};
  private corners: Uint8Array | null = null;
  private texture: THREE.DataTexture | null = null;
  private words = new Uint32Array(0);

  constructor(private readonly p: Packed) {
    this.colours = new Uint8Array(4 * p.n);
  }

  get points(): THREE.BufferGeometry {
    return (this.made.points ??= this.bound((geometry) => {
      const [normals, reach] = pointsOf(this.p);
      geometry.setAttribute("position", new THREE.BufferAttribute(this.p.mean, 3));
      geometry.setAttribute("aNormal", new THREE.BufferAttribute(normals, 4, true));
      geometry.setAttribute("aReach", new THREE.BufferAttribute(reach, 1));
      geometry.setAttribute("aColour", new THREE.BufferAttribute(this.colours, 4, true));
    }));
  }

  get discs(): THREE.BufferGeometry {
    return (this.made.discs ??= this.bound((geometry) => {
      const [at, normals] = discsOf(this.p);
      this.corners = new Uint8Array(12 * this.p.n);
      geometry.setAttribute("position", new THREE.BufferAttribute(at, 3));
      geometry.setAttribute("aNormal", new THREE.BufferAttribute(normals, 4, true));
      geometry.setAttribute("aColour", new THREE.BufferAttribute(this.corners, 4, true));
      this.toCorners();
    }));
  }

  get ellipsoids(): THREE.BufferGeometry {
    return (this.made.ellipsoids ??= this.bound((geometry) => {
      this.words = wordsOf(this.p);
      this.texture = new THREE.DataTexture(this.words, ROW, this.words.length / (4 * ROW), THREE.RGBAIntegerFormat, THREE.UnsignedIntType);
      this.texture.internalFormat = "RGBA32UI";
      geometry.setDrawRange(0, 3 * this.p.n);
      this.toTexture();
    }));
  }

  /** Gives the uniforms of a material what this version has of its own. */
  lend(uniforms: Record<string, THREE.IUniform>): void {
    if (uniforms.uData) uniforms.uData.value = this.texture;
    uniforms.uFlashAt.value = this.flashAt;
  }

  paint(colour: (row: number) => [number, number, number]): void {
    for (let i = 0; i < this.p.n; i++) {
      const [r, g, b] = colour(i);
      this.colours[4 * i] = r;
      this.colours[4 * i + 1] = g;
      this.colours[4 * i + 2] = b;
    }
    this.toGpu();
  }

  /** Lets some rows flash from now on. */
  flash(rows: number[], now_s: number): void {
    for (const row of rows) this.colours[4 * row + 3] = FLASHES;
    this.flashAt = now_s;
    this.toGpu();
  }

  dispose(): void {
    for (const geometry of Object.values(this.made)) geometry.dispose();
    this.texture?.dispose();
  }

  private toGpu(): void {
    if (this.made.points) this.made.points.getAttribute("aColour").needsUpdate = true;
    if (this.corners) this.toCorners();
    if (this.texture) this.toTexture();
  }

  private toCorners(): void {
    const [from, into] = [new Uint32Array(this.colours.buffer), new Uint32Array(this.corners!.buffer)];
    for (let i = 0; i < into.length; i++) into[i] = from[(i / 3) | 0];
    if (this.made.discs) this.made.discs.getAttribute("aColour").needsUpdate = true;
  }

  private toTexture(): void {
    const colours = new Uint32Array(this.colours.buffer);
    for (let i = 0; i < this.p.n; i++) this.words[8 * i + 3] = colours[i];
    this.texture!.needsUpdate = true;
  }

  private bound(fill: (geometry: THREE.BufferGeometry) => void): THREE.BufferGeometry {
    const geometry = new THREE.BufferGeometry();
    const { n, low, high } = this.p;
    const middle = new THREE.Vector3(0, 0, n ? (low + high) / 2 : 0);
    geometry.boundingSphere = new THREE.Sphere(middle, 30 + (n ? (high - low) / 2 : 0));
    geometry.userData.drawable = this;
    fill(geometry);
    return geometry;
  }
}

/** The normal of each disc, and the radius, m, of the round one that is as large. */
function pointsOf(p: Packed): [Int8Array, Float32Array] {
  const normals = new Int8Array(4 * p.n);
  const reach = new Float32Array(p.n);
  for (let i = 0; i < p.n; i++) {
    const [x, y, z, w] = [p.turn[4 * i] / 32767, p.turn[4 * i + 1] / 32767, p.turn[4 * i + 2] / 32767, p.turn[4 * i + 3] / 32767];
    const third = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)];
    for (let k = 0; k < 3; k++) normals[4 * i + k] = Math.round(127 * third[k]);
    const [a, b] = [0, 1].map((k) => Math.max(p.shape[4 * i + k] * METRES_PER_STEP * SIGMAS, 0.05));
    reach[i] = Math.sqrt(a * b);
  }
  return [normals, reach];
}

/** The corners of a triangle around each disc, and its normal at each of them. */
function discsOf(p: Packed): [Float32Array, Int8Array] {
  const at = new Float32Array(9 * p.n);
  const normals = new Int8Array(12 * p.n);
  for (let i = 0; i < p.n; i++) {
    const [x, y, z, w] = [p.turn[4 * i] / 32767, p.turn[4 * i + 1] / 32767, p.turn[4 * i + 2] / 32767, p.turn[4 * i + 3] / 32767];
    const a = Math.max(p.shape[4 * i] * METRES_PER_STEP * SIGMAS, 0.05);
    const b = Math.max(p.shape[4 * i + 1] * METRES_PER_STEP * SIGMAS, 0.05);
    const first = [a * (1 - 2 * (y * y + z * z)), a * 2 * (x * y + w * z), a * 2 * (x * z - w * y)];
    const second = [b * 2 * (x * y - w * z), b * (1 - 2 * (x * x + z * z)), b * 2 * (y * z + w * x)];
    const third = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)];
    for (let c = 0; c < 3; c++) {
      for (let k = 0; k < 3; k++) {
        at[9 * i + 3 * c + k] = p.mean[3 * i + k] + CORNERS[2 * c] * first[k] + CORNERS[2 * c + 1] * second[k];
        normals[12 * i + 4 * c + k] = Math.round(127 * third[k]);
      }
    }
  }
  return [at, normals];
}

/** Eight words a Gaussian: mean (3 floats), colour, turn (2 x 2), shape (2 x 2); in whole rows of the texture. */
function wordsOf(p: Packed): Uint32Array<ArrayBuffer> {
  const words = new Uint32Array(4 * ROW * Math.max(1, Math.ceil((2 * p.n) / ROW)));
  const floats = new Float32Array(words.buffer);
  const turn = new Uint32Array(p.turn.buffer, p.turn.byteOffset, 2 * p.n);
  const shape = new Uint32Array(p.shape.buffer, p.shape.byteOffset, 2 * p.n);
  for (let i = 0; i < p.n; i++) {
    floats.set(p.mean.subarray(3 * i, 3 * i + 3), 8 * i);
    words.set(turn.subarray(2 * i, 2 * i + 2), 8 * i + 4);
    words.set(shape.subarray(2 * i, 2 * i + 2), 8 * i + 6);
  }
  return words;
}

/** A mesh whose material is lent what its geometry has of its own. */
export function meshOf(geometry: THREE.BufferGeometry, material: THREE.Material): THREE.Mesh {
  return lent(new THREE.Mesh(geometry, material));
}

/** The same of points. */
export function pointsMesh(material: THREE.Material): THREE.Points {
  return lent(new THREE.Points(new THREE.BufferGeometry(), material));
}

function lent<T extends THREE.Mesh | THREE.Points>(mesh: T): T {
  mesh.matrixAutoUpdate = false;
  mesh.onBeforeRender = (_renderer, _scene, _camera, of, used) => {
    const look = used as THREE.ShaderMaterial;
    (of.userData.drawable as Drawable).lend(look.uniforms);
    look.uniformsNeedUpdate = true;
  };
  return mesh;
}

export function paint(drawable: Drawable, p: Packed, up_m: number, shades: Shades): void {
  drawable.paint((row) => colourOf(p, row, up_m, shades));
}

/** The nearest Gaussian that a ray meets, in the tile's frame; the distance along the ray, or null. */
export function meets(p: Packed, from: THREE.Vector3, along: THREE.Vector3): { row: number; far: number } | null {
  let best: { row: number; far: number } | null = null;
  for (let i = 0; i < p.n; i++) {
    const ox = p.mean[3 * i] - from.x;
    const oy = p.mean[3 * i + 1] - from.y;
    const oz = p.mean[3 * i + 2] - from.z;
    const t = ox * along.x + oy * along.y + oz * along.z;
    if (t <= 0 || ox * ox + oy * oy + oz * oz - t * t > 6.25) continue;
    const far = through(p, i, ox, oy, oz, along);
    if (far !== null && (best === null || far < best.far)) best = { row: i, far };
  }
  return best;
}

/** Where a ray from the origin enters the ellipsoid of a row whose centre is at (ox, oy, oz). */
function through(p: Packed, i: number, ox: number, oy: number, oz: number, d: THREE.Vector3): number | null {
  const [x, y, z, w] = [0, 1, 2, 3].map((c) => p.turn[4 * i + c] / 32767);
  const R = [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
  let a = 0;
  let b = 0;
  let c = -1;
  for (let k = 0; k < 3; k++) {
    const s = Math.max(p.shape[4 * i + k] * METRES_PER_STEP * SIGMAS, k === 2 ? 0.05 : 0.05);
    const e = -(R[k][0] * ox + R[k][1] * oy + R[k][2] * oz) / s;
    const r = (R[k][0] * d.x + R[k][1] * d.y + R[k][2] * d.z) / s;
    a += r * r;
    b += e * r;
    c += e * e;
  }
  const inside = b * b - a * c;
  return inside < 0 ? null : (-b - Math.sqrt(inside)) / a;
}
