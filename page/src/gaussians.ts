// Gaussians on the GPU: two triangles each. Near ones are ellipsoids that the fragment shader meets with the ray of its
// pixel, far ones discs along their two longest axes.

import * as THREE from "three";
import { colourOf, type Shades } from "./colours";
import { METRES_PER_STEP, type Packed } from "./packed";

const FULL_M = 65535 * METRES_PER_STEP;
export const SIGMAS = 2.0;
export const FLASH_S = 2.5;

const COMMON = /* glsl */ `
  in vec3 aMean; in vec4 aTurn; in vec4 aShape; in vec4 aColour; in float aFlash;
  uniform float uTime; uniform float uGrow; uniform vec3 uFlash;
  mat3 axes(vec4 raw) {
    vec4 q = raw / length(raw);
    vec3 x = q.xyz + q.xyz; vec3 d = q.xyz * x; vec3 w = q.w * x;
    float xy = q.x * x.y, xz = q.x * x.z, yz = q.y * x.z;
    return mat3(1.0 - d.y - d.z, xy + w.z, xz - w.y,
                xy - w.z, 1.0 - d.x - d.z, yz + w.x,
                xz + w.y, yz - w.x, 1.0 - d.x - d.y);
  }
  vec3 halfAxes() { return max(aShape.xyz * ${FULL_M.toFixed(5)} * ${SIGMAS.toFixed(1)}, vec3(0.05, 0.05, 0.02)); }
  vec3 lit(vec3 colour) {
    float glow = aFlash > 0.0 ? clamp(1.0 - (uTime - aFlash) / ${FLASH_S.toFixed(1)}, 0.0, 1.0) : 0.0;
    return mix(colour, uFlash, glow * 0.85);
  }
`;

const SHADE = /* glsl */ `
  uniform float uGhost;
  vec3 shaded(vec3 colour, vec3 n) {
    float light = 0.58 + 0.30 * max(dot(n, normalize(vec3(0.25, 0.55, 0.8))), 0.0) + 0.14 * max(n.y, 0.0);
    return colour * light;
  }
  void stipple() {
    if (uGhost > 0.0 && mod(floor(gl_FragCoord.x) + floor(gl_FragCoord.y), 2.0) > 0.5) discard;
  }
`;

const DISC_VERTEX = /* glsl */ `
  ${COMMON}
  out vec2 vCorner; out vec3 vColour; out vec3 vNormal;
  void main() {
    mat3 R = axes(aTurn); vec3 s = halfAxes() * uGrow;
    mat3 toView = mat3(modelViewMatrix);
    vec3 n = normalize(toView * R[2]);
    vec3 a = toView * R[0] * s.x, b = toView * R[1] * s.y;
    vec4 centre = modelViewMatrix * vec4(aMean, 1.0);
    if (s.z > 0.4 * s.x) { // round ones face the viewer
      float r = (s.x + s.y + s.z) / 3.0; a = vec3(r, 0.0, 0.0); b = vec3(0.0, r, 0.0); n = vec3(0.0, 0.35, 0.94);
    }
    if (dot(n, centre.xyz) > 0.0) n = -n;
    vCorner = position.xy; vColour = lit(aColour.rgb); vNormal = n;
    gl_Position = projectionMatrix * (centre + vec4(position.x * a + position.y * b, 0.0));
  }
`;

const DISC_FRAGMENT = /* glsl */ `
  ${SHADE}
  in vec2 vCorner; in vec3 vColour; in vec3 vNormal;
  out vec4 pixel;
  void main() {
    if (dot(vCorner, vCorner) > 1.0) discard;
    stipple();
    pixel = vec4(shaded(vColour, vNormal), 1.0);
  }
`;

const ELLIPSOID_VERTEX = /* glsl */ `
  ${COMMON}
  out vec3 vAt; out vec3 vRay; flat out vec3 vEye; flat out vec3 vColour; flat out mat3 vBack;
  void main() {
    vec3 s = halfAxes() * uGrow;
    mat3 V = mat3(modelViewMatrix) * axes(aTurn);
    mat3 M = mat3(V[0] * s.x, V[1] * s.y, V[2] * s.z);
    vec3 c = (modelViewMatrix * vec4(aMean, 1.0)).xyz;
    vec3 reach = sqrt(vec3(
      M[0].x * M[0].x + M[1].x * M[1].x + M[2].x * M[2].x,
      M[0].y * M[0].y + M[1].y * M[1].y + M[2].y * M[2].y,
      M[0].z * M[0].z + M[1].z * M[1].z + M[2].z * M[2].z));
    // A plane before the ellipsoid, around the ray to its middle: wide enough for what is seen aslant.
    float nearer = min((c.z + reach.z) / c.z, 1.0);
    vec2 wide = reach.xy + abs(c.xy / c.z) * reach.z;
    vec3 at = vec3(c.xy * nearer + position.xy * wide, c.z * nearer);
    if (at.z > -0.05) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; }
    mat3 inverseM = transpose(mat3(V[0] / s.x, V[1] / s.y, V[2] / s.z));
    vBack = transpose(inverseM); vEye = inverseM * -c; vRay = inverseM * at; vAt = at;
    vColour = lit(aColour.rgb);
    gl_Position = projectionMatrix * vec4(at, 1.0);
  }
`;

const ELLIPSOID_FRAGMENT = /* glsl */ `
  ${SHADE}
  uniform mat4 projectionMatrix;
  in vec3 vAt; in vec3 vRay; flat in vec3 vEye; flat in vec3 vColour; flat in mat3 vBack;
  out vec4 pixel;
  void main() {
    float a = dot(vRay, vRay), b = dot(vEye, vRay), c = dot(vEye, vEye) - 1.0;
    float inside = b * b - a * c;
    if (inside < 0.0) discard;
    float t = (-b - sqrt(inside)) / a;
    if (t <= 0.0) discard;
    stipple();
    vec3 n = normalize(vBack * (vEye + t * vRay));
    float z = t * vAt.z;
    gl_FragDepth = 0.5 + 0.5 * (projectionMatrix[2].z * z + projectionMatrix[3].z) / -z;
    pixel = vec4(shaded(vColour, n), 1.0);
  }
`;

export interface Looks {
  disc: THREE.ShaderMaterial;
  ellipsoid: THREE.ShaderMaterial;
  ghost: THREE.ShaderMaterial;
  uniforms: { uTime: { value: number }; uFlash: { value: THREE.Color } };
}

export function looks(): Looks {
  const uniforms = { uTime: { value: 0 }, uFlash: { value: new THREE.Color(1, 1, 1) } };
  const make = (vertexShader: string, fragmentShader: string, ghost: number) =>
    new THREE.ShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader,
      fragmentShader,
      uniforms: { ...uniforms, uGhost: { value: ghost }, uGrow: { value: 1 } },
      side: THREE.DoubleSide,
    });
  return {
    disc: make(DISC_VERTEX, DISC_FRAGMENT, 0),
    ellipsoid: make(ELLIPSOID_VERTEX, ELLIPSOID_FRAGMENT, 0),
    ghost: make(DISC_VERTEX, DISC_FRAGMENT, 1),
    uniforms,
  };
}

const CORNERS = new THREE.BufferAttribute(new Float32Array([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0]), 3);
const INDEX = new THREE.BufferAttribute(new Uint16Array([0, 1, 2, 0, 2, 3]), 1);

/** Columns of a version as instanced attributes. */
export function geometryOf(p: Packed): THREE.InstancedBufferGeometry {
  const geometry = new THREE.InstancedBufferGeometry();
  geometry.setAttribute("position", CORNERS);
  geometry.setIndex(INDEX);
  const add = (name: string, array: any, width: number, normalised: boolean) =>
    geometry.setAttribute(name, new THREE.InstancedBufferAttribute(array, width, normalised));
  add("aMean", p.mean, 3, false);
  add("aTurn", p.turn, 4, true);
  add("aShape", p.shape, 4, true);
  add("aColour", new Uint8Array(4 * p.n), 4, true);
  add("aFlash", new Float32Array(p.n), 1, false);
  geometry.instanceCount = p.n;
  const middle = p.n ? (p.low + p.high) / 2 : 0;
  const radius = 30 + (p.n ? (p.high - p.low) / 2 : 0);
  geometry.boundingSphere = new THREE.Sphere(new THREE.Vector3(0, 0, middle), radius);
  return geometry;
}

export function paint(geometry: THREE.InstancedBufferGeometry, p: Packed, up_m: number, shades: Shades): void {
  const attribute = geometry.getAttribute("aColour") as THREE.InstancedBufferAttribute;
  const into = attribute.array as Uint8Array;
  for (let i = 0; i < p.n; i++) {
    const [r, g, b] = colourOf(p, i, up_m, shades);
    into[4 * i] = r;
    into[4 * i + 1] = g;
    into[4 * i + 2] = b;
    into[4 * i + 3] = 255;
  }
  attribute.needsUpdate = true;
}

export function paintOne(geometry: THREE.InstancedBufferGeometry, colour: [number, number, number]): void {
  const attribute = geometry.getAttribute("aColour") as THREE.InstancedBufferAttribute;
  const into = attribute.array as Uint8Array;
  for (let i = 0; i < into.length; i += 4) into.set([...colour, 255], i);
  attribute.needsUpdate = true;
}

export function flash(geometry: THREE.InstancedBufferGeometry, rows: number[], now_s: number): void {
  const attribute = geometry.getAttribute("aFlash") as THREE.InstancedBufferAttribute;
  for (const row of rows) (attribute.array as Float32Array)[row] = now_s;
  attribute.needsUpdate = true;
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
