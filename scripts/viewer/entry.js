// What the pages of 'aw view' use.
export * as THREE from "./three.js";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
