//! The panel in three dimensions: relief, microphone, speaker, paths and first Fresnel zones. Loaded when shown.
import {
  AmbientLight,
  BufferAttribute,
  BufferGeometry,
  Color,
  ConeGeometry,
  CylinderGeometry,
  DirectionalLight,
  Line,
  LineBasicMaterial,
  LineDashedMaterial,
  LineLoop,
  Matrix4,
  Mesh,
  MeshLambertMaterial,
  MeshBasicMaterial,
  Object3D,
  PerspectiveCamera,
  PlaneGeometry,
  Quaternion,
  Scene,
  SphereGeometry,
  Vector3,
  WebGLRenderer,
  Group,
} from 'three'
import { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js'
import { fresnelZone, specular, type Vec3 } from './geometry'
import type { FramePose } from './replay'

export interface ReliefColours {
  paper: string
  relief: string
  microphone: string
  speaker: string
  ink: string
  zone: string
  arm: string
}
export interface Relief {
  setPair(microphone: Vec3 | null, speaker: Vec3 | null): void
  /** Draws links between the frames of both arms; nothing without poses. */
  setArms(poses: readonly FramePose[]): void
  /** `isNow`: before the next frame, for a printer takes what is drawn. */
  setColours(colours: ReliefColours, isNow: boolean): void
  setHeights(heights: Float32Array, size_mm: number): void
  turn(dx: number, dy: number): void
  zoom(factor: number): void
  resize(width: number, height: number): void
  dispose(): void
}

const v = (p: Vec3) => new Vector3(p[0], p[1], p[2])
const ZONE_LIFT_MM = 1.5
const ARM_RADIUS_MM = 9

/** Both ends of every link of the arms, mm in the panel's frame. */
function findLinks(poses: readonly FramePose[]): [Vector3, Vector3][] {
  const worlds = new Map<string, Matrix4>()
  for (const { parent_frame_id, child_frame_id, translation: t, rotation: r } of poses) {
    const own = new Matrix4().compose(
      new Vector3(t.x, t.y, t.z).multiplyScalar(1000),
      new Quaternion(r.x, r.y, r.z, r.w),
      new Vector3(1, 1, 1),
    )
    worlds.set(child_frame_id, (worlds.get(parent_frame_id) ?? new Matrix4()).clone().multiply(own))
  }
  const toPanel = (worlds.get('panel') ?? new Matrix4()).clone().invert()
  const originOf = (frame: string) => new Vector3().setFromMatrixPosition(worlds.get(frame)!).applyMatrix4(toPanel)
  return poses
    .filter((pose) => worlds.has(pose.parent_frame_id))
    .map((pose) => [originOf(pose.parent_frame_id), originOf(pose.child_frame_id)])
}

/** A scene on a canvas; it draws only when something changed. */
export function relief(
  canvas: HTMLCanvasElement,
  colours: ReliefColours,
  grid: readonly Vec3[],
  reduced: boolean,
): Relief {
  const renderer = new WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true })
  renderer.setPixelRatio(Math.min(2, devicePixelRatio || 1))
  const scene = new Scene()
  const camera = new PerspectiveCamera(32, 1, 10, 10_000)
  camera.up.set(0, 0, 1)
  camera.position.set(-620, -1120, 820)
  const controls = new OrbitControls(camera, canvas)
  controls.target.set(0, 0, 130)
  controls.enableDamping = false
  controls.minDistance = 300
  controls.maxDistance = 4000
  controls.zoomSpeed = reduced ? 0.5 : 1
  controls.enableZoom = false
  canvas.addEventListener('dblclick', () => {
    controls.enableZoom = !controls.enableZoom
  })
  scene.add(new AmbientLight(0xffffff, 1.1))
  const sun = new DirectionalLight(0xffffff, 2.6)
  sun.position.set(-500, 500, 560)
  scene.add(sun)

  const panel = new Mesh(new PlaneGeometry(1, 1), new MeshLambertMaterial({ color: colours.relief }))
  scene.add(panel)
  const pair = new Group()
  scene.add(pair)
  const points = new Group()
  scene.add(points)
  const arms = new Group()
  scene.add(arms)
  let shown: [Vec3 | null, Vec3 | null] = [null, null]
  let frame = 0
  const draw = () => {
    frame = 0
    renderer.render(scene, camera)
  }
  const later = () => {
    if (!frame) frame = requestAnimationFrame(draw)
  }
  controls.addEventListener('change', later)

  function clear(group: Group) {
    for (const child of [...group.children]) {
      group.remove(child)
      free(child)
    }
  }
  function free(object: Object3D) {
    const mesh = object as Mesh
    mesh.geometry?.dispose()
    if (mesh.material && !Array.isArray(mesh.material)) mesh.material.dispose()
  }
  function path(corners: readonly Vec3[], colour: string, dashed: boolean) {
    const line = new Line(
      new BufferGeometry().setFromPoints(corners.map(v)),
      dashed
        ? new LineDashedMaterial({ color: colour, dashSize: 14, gapSize: 10 })
        : new LineBasicMaterial({ color: colour }),
    )
    line.computeLineDistances()
    pair.add(line)
  }
  function zone(a: Vec3, b: Vec3, frequency_hz: number) {
    const z = fresnelZone(a, b, frequency_hz)
    const ring = Array.from({ length: 96 }, (_, i) => {
      const t = (2 * Math.PI * i) / 96
      const [x, y] = [z.along * Math.cos(t), z.across * Math.sin(t)]
      return new Vector3(
        z.centre[0] + x * Math.cos(z.angle) - y * Math.sin(z.angle),
        z.centre[1] + x * Math.sin(z.angle) + y * Math.cos(z.angle),
        top + ZONE_LIFT_MM,
      )
    })
    pair.add(new LineLoop(new BufferGeometry().setFromPoints(ring), new LineBasicMaterial({ color: colours.zone })))
  }
  let top = 0

  function rebuild() {
    clear(pair)
    clear(points)
    const [m, s] = shown
    for (const point of grid) {
      const dot = new Mesh(new SphereGeometry(3.2, 8, 6), new MeshBasicMaterial({ color: colours.ink }))
      dot.position.copy(v(point))
      points.add(dot)
    }
    if (m) {
      const ball = new Mesh(new SphereGeometry(12, 24, 16), new MeshLambertMaterial({ color: colours.microphone }))
      ball.position.copy(v(m))
      pair.add(ball)
    }
    if (m && s) {
      const cone = new Mesh(new ConeGeometry(16, 30, 24), new MeshLambertMaterial({ color: colours.speaker }))
      cone.rotation.x = Math.PI / 2
      cone.position.copy(v(s))
      pair.add(cone)
      path([m, s], colours.ink, true)
      path([s, specular(m, s), m], colours.speaker, false)
      zone(m, s, 2000)
      zone(m, s, 40000)
    }
    later()
  }

  return {
    setPair(microphone, speaker) {
      shown = [microphone, speaker]
      rebuild()
    },
    setArms(poses) {
      clear(arms)
      for (const [from, to] of findLinks(poses)) {
        const length = from.distanceTo(to)
        if (length < 1) continue
        const link = new Mesh(
          new CylinderGeometry(ARM_RADIUS_MM, ARM_RADIUS_MM, length, 12),
          new MeshLambertMaterial({ color: colours.arm }),
        )
        link.position.copy(from).lerp(to, 0.5)
        link.quaternion.setFromUnitVectors(new Vector3(0, 1, 0), to.clone().sub(from).normalize())
        arms.add(link)
      }
      later()
    },
    setColours(next, isNow) {
      colours = next
      for (const link of arms.children) ((link as Mesh).material as MeshLambertMaterial).color.set(next.arm)
      scene.background = new Color(next.paper)
      ;(panel.material as MeshLambertMaterial).color.set(next.relief)
      rebuild()
      if (isNow) draw()
    },
    setHeights(heights, size_mm) {
      const cells = Math.round(Math.sqrt(heights.length))
      const pitch = size_mm / cells
      const plane = new PlaneGeometry(size_mm - pitch, size_mm - pitch, cells - 1, cells - 1)
      const position = plane.getAttribute('position') as BufferAttribute
      top = -Infinity
      for (let row = 0; row < cells; row += 1) {
        for (let column = 0; column < cells; column += 1) {
          const height = heights[(cells - 1 - row) * cells + column]
          top = Math.max(top, height)
          position.setZ(row * cells + column, height)
        }
      }
      plane.computeVertexNormals()
      panel.geometry.dispose()
      panel.geometry = plane
      rebuild()
    },
    turn(dx, dy) {
      const offset = camera.position.clone().sub(controls.target)
      offset.applyAxisAngle(new Vector3(0, 0, 1), dx)
      const side = new Vector3().crossVectors(offset, camera.up).normalize()
      const tilted = offset.clone().applyAxisAngle(side, dy)
      const angle = tilted.angleTo(camera.up)
      if (angle > 0.08 && angle < 1.55) offset.copy(tilted)
      camera.position.copy(controls.target).add(offset)
      controls.update()
      later()
    },
    zoom(factor) {
      camera.position.sub(controls.target).multiplyScalar(factor).add(controls.target)
      controls.update()
      later()
    },
    resize(width, height) {
      renderer.setSize(width, height, false)
      camera.aspect = width / height
      camera.fov = width / height < 1 ? 42 : 32
      camera.updateProjectionMatrix()
      later()
    },
    dispose() {
      if (frame) cancelAnimationFrame(frame)
      clear(pair)
      clear(points)
      clear(arms)
      free(panel)
      controls.dispose()
      renderer.dispose()
    },
  }
}
