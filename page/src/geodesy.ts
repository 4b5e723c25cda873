// The map's frame and the Earth: east, north and up at the origin on the WGS-84 ellipsoid.

const A = 6378137.0;
const E2 = 6.69437999014e-3;
const RAD = Math.PI / 180;

type Triple = [number, number, number];

function ecef(lat: number, lon: number, height: number): Triple {
  const n = A / Math.sqrt(1 - E2 * Math.sin(lat) ** 2);
  return [
    (n + height) * Math.cos(lat) * Math.cos(lon),
    (n + height) * Math.cos(lat) * Math.sin(lon),
    (n * (1 - E2) + height) * Math.sin(lat),
  ];
}

export class Frame {
  private readonly origin: Triple;
  private readonly axes: [Triple, Triple, Triple];

  constructor(lat_deg: number, lon_deg: number) {
    const [lat, lon] = [lat_deg * RAD, lon_deg * RAD];
    const [sa, ca, so, co] = [Math.sin(lat), Math.cos(lat), Math.sin(lon), Math.cos(lon)];
    this.origin = ecef(lat, lon, 0);
    this.axes = [[-so, co, 0], [-sa * co, -sa * so, ca], [ca * co, ca * so, sa]];
  }

  /** Degrees and metres above the ellipsoid. */
  toDegrees(enu: Triple): Triple {
    const p = [0, 1, 2].map((c) => this.origin[c] + this.axes.reduce((sum, axis, k) => sum + axis[c] * enu[k], 0));
    const across = Math.hypot(p[0], p[1]);
    let lat = Math.atan2(p[2], across * (1 - E2));
    let height = 0;
    for (let i = 0; i < 5; i++) {
      const n = A / Math.sqrt(1 - E2 * Math.sin(lat) ** 2);
      height = across / Math.cos(lat) - n;
      lat = Math.atan2(p[2], across * (1 - (E2 * n) / (n + height)));
    }
    return [lat / RAD, Math.atan2(p[1], p[0]) / RAD, height];
  }

  toMap(lat_deg: number, lon_deg: number, height: number): Triple {
    const p = ecef(lat_deg * RAD, lon_deg * RAD, height).map((one, c) => one - this.origin[c]);
    return this.axes.map((axis) => axis[0] * p[0] + axis[1] * p[1] + axis[2] * p[2]) as Triple;
  }
}
