"use strict";
// A model's shapes as geometries in their bodies, and lines on its planes.
const shapesOf = (told) => {
  function bytes(text) {
    return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  }
  const floats = (text) => new Float32Array(bytes(text));

  const decade = 10 ** Math.floor(Math.log10(told.radius / 2));
  const cell = [5, 2, 1].find((step) => step * decade <= told.radius / 2) * decade;
  const wide = Math.ceil((1.5 * told.radius) / cell) * cell;

  // A plane without end is drawn below what moves.
  function below(shape) {
    const [w, x, y, z] = shape.quaternion;
    const own = new THREE.Vector3(...told.centre).sub(new THREE.Vector3(...shape.position));
    own.applyQuaternion(new THREE.Quaternion(x, y, z, w).invert());
    return [shape.size[0] ? 0 : Math.round(own.x / cell) * cell, shape.size[1] ? 0 : Math.round(own.y / cell) * cell];
  }

  function geometry(shape) {
    const [a, b, c] = shape.size;
    switch (shape.kind) {
      case "plane": {
        const [x, y] = below(shape);
        return new THREE.PlaneGeometry(2 * (a || wide), 2 * (b || wide)).translate(x, y, 0);
      }
      case "sphere": return new THREE.SphereGeometry(a, 24, 16);
      case "ellipsoid": return new THREE.SphereGeometry(1, 24, 16).scale(a, b, c);
      case "capsule": return new THREE.CapsuleGeometry(a, 2 * b, 8, 20).rotateX(Math.PI / 2);
      case "cylinder": return new THREE.CylinderGeometry(a, a, 2 * b, 28).rotateX(Math.PI / 2);
      case "box": return new THREE.BoxGeometry(2 * a, 2 * b, 2 * c);
      default: {
        const mesh = new THREE.BufferGeometry();
        mesh.setAttribute("position", new THREE.BufferAttribute(floats(shape.vertices), 3));
        mesh.setIndex(new THREE.BufferAttribute(new Uint32Array(bytes(shape.faces)), 1));
        const flat = mesh.toNonIndexed();
        flat.computeVertexNormals();
        return flat;
      }
    }
  }

  function place(mesh, shape) {
    const [w, x, y, z] = shape.quaternion;
    mesh.position.set(...shape.position);
    mesh.quaternion.set(x, y, z, w);
    return mesh;
  }

  function grid(x, y, ink) {
    const corners = [];
    for (let offset = -wide; offset <= wide + cell / 2; offset += cell) {
      corners.push(x + offset, y - wide, 0, x + offset, y + wide, 0, x - wide, y + offset, 0, x + wide, y + offset, 0);
    }
    const lines = new THREE.BufferGeometry();
    lines.setAttribute("position", new THREE.BufferAttribute(new Float32Array(corners), 3));
    return new THREE.LineSegments(lines, ink);
  }

  return { floats, geometry, place, below, grid, cell };
};
