//! Embree 4 through its C interface, found at run time in a shared library.
//!
//! Names and layouts are those of `embree4/rtcore*.h`.

use std::ffi::{c_char, c_void};
use std::path::Path;

use libloading::Library;

type Handle = *mut c_void;

const GEOMETRY_TYPE_TRIANGLE: u32 = 0;
const BUFFER_TYPE_INDEX: u32 = 0;
const BUFFER_TYPE_VERTEX: u32 = 1;
const FORMAT_UINT3: u32 = 0x5003;
const FORMAT_FLOAT3: u32 = 0x9003;
const SCENE_FLAG_ROBUST: u32 = 4;
const BUILD_QUALITY_MEDIUM: u32 = 1;

/// `RTCRay`.
#[repr(C, align(16))]
struct RtcRay {
    origin: [f32; 3],
    t_near: f32,
    direction: [f32; 3],
    time: f32,
    t_far: f32,
    mask: u32,
    id: u32,
    flags: u32,
}

/// The functions used here.
struct Api {
    new_device: unsafe extern "C" fn(*const c_char) -> Handle,
    device_error: unsafe extern "C" fn(Handle) -> u32,
    device_property: unsafe extern "C" fn(Handle, u32) -> isize,
    new_scene: unsafe extern "C" fn(Handle) -> Handle,
    set_scene_flags: unsafe extern "C" fn(Handle, u32),
    set_scene_build_quality: unsafe extern "C" fn(Handle, u32),
    new_geometry: unsafe extern "C" fn(Handle, u32) -> Handle,
    set_new_buffer: unsafe extern "C" fn(Handle, u32, u32, u32, usize, usize) -> *mut c_void,
    commit_geometry: unsafe extern "C" fn(Handle),
    attach_geometry: unsafe extern "C" fn(Handle, Handle) -> u32,
    release_geometry: unsafe extern "C" fn(Handle),
    commit_scene: unsafe extern "C" fn(Handle),
    occluded1: unsafe extern "C" fn(Handle, *mut RtcRay, *mut c_void),
}

/// The loaded library and its device.
pub struct Embree {
    api: Api,
    device: Handle,
    /// As the library tells it.
    pub version: String,
}

/// Triangles of one geometry.
pub struct Mesh {
    pub positions: Vec<[f32; 3]>,
    pub triangles: Vec<[u32; 3]>,
}

/// A committed scene.
pub struct Scene<'a> {
    embree: &'a Embree,
    scene: Handle,
}

// SAFETY: Embree's device and committed scenes may be used by any number of threads (its documentation, "Thread Safety").
unsafe impl Sync for Embree {}
// SAFETY: as above.
unsafe impl Sync for Scene<'_> {}

impl Embree {
    /// Loads the library and makes a device. The library stays loaded: unloading it crashes.
    pub fn load(path: &Path) -> Result<Self, String> {
        // SAFETY: the library's initialisers have no requirements.
        let library = unsafe { Library::new(path) }.map_err(|error| error.to_string())?;
        let library: &'static Library = Box::leak(Box::new(library));
        macro_rules! function {
            ($name:literal) => {
                // SAFETY: the type is that of the header's declaration.
                *unsafe { library.get($name) }.map_err(|error| error.to_string())?
            };
        }
        let api = Api {
            new_device: function!(b"rtcNewDevice\0"),
            device_error: function!(b"rtcGetDeviceError\0"),
            device_property: function!(b"rtcGetDeviceProperty\0"),
            new_scene: function!(b"rtcNewScene\0"),
            set_scene_flags: function!(b"rtcSetSceneFlags\0"),
            set_scene_build_quality: function!(b"rtcSetSceneBuildQuality\0"),
            new_geometry: function!(b"rtcNewGeometry\0"),
            set_new_buffer: function!(b"rtcSetNewGeometryBuffer\0"),
            commit_geometry: function!(b"rtcCommitGeometry\0"),
            attach_geometry: function!(b"rtcAttachGeometry\0"),
            release_geometry: function!(b"rtcReleaseGeometry\0"),
            commit_scene: function!(b"rtcCommitScene\0"),
            occluded1: function!(b"rtcOccluded1\0"),
        };
        // SAFETY: a null configuration means the defaults; property 0 is the version.
        let (device, version) = unsafe {
            let device = (api.new_device)(std::ptr::null());
            if device.is_null() {
                return Err("Embree makes no device".into());
            }
            (device, (api.device_property)(device, 0))
        };
        let version = format!("{}.{}.{}", version / 10_000, version / 100 % 100, version % 100);
        Ok(Self { api, device, version })
    }

    /// Builds a scene with the flag ROBUST at medium quality, one geometry a mesh.
    pub fn build(&self, meshes: &[Mesh]) -> Scene<'_> {
        let api = &self.api;
        // SAFETY: calls in the order that the manual shows; each buffer holds exactly what is copied into it (Embree pads the
        // last vertex itself).
        let scene = unsafe {
            let scene = (api.new_scene)(self.device);
            (api.set_scene_flags)(scene, SCENE_FLAG_ROBUST);
            (api.set_scene_build_quality)(scene, BUILD_QUALITY_MEDIUM);
            for mesh in meshes {
                let geometry = (api.new_geometry)(self.device, GEOMETRY_TYPE_TRIANGLE);
                let vertices =
                    (api.set_new_buffer)(geometry, BUFFER_TYPE_VERTEX, 0, FORMAT_FLOAT3, 12, mesh.positions.len());
                std::ptr::copy_nonoverlapping(mesh.positions.as_ptr(), vertices.cast(), mesh.positions.len());
                let indices =
                    (api.set_new_buffer)(geometry, BUFFER_TYPE_INDEX, 0, FORMAT_UINT3, 12, mesh.triangles.len());
                std::ptr::copy_nonoverlapping(mesh.triangles.as_ptr(), indices.cast(), mesh.triangles.len());
                (api.commit_geometry)(geometry);
                (api.attach_geometry)(scene, geometry);
                (api.release_geometry)(geometry);
            }
            (api.commit_scene)(scene);
            scene
        };
        // SAFETY: the device is alive.
        let error = unsafe { (api.device_error)(self.device) };
        assert_eq!(error, 0, "Embree reports error {error}");
        Scene { embree: self, scene }
    }
}

impl Scene<'_> {
    /// Whether anything lies on `origin + t · direction` for `t` in `[0, t_far]`.
    #[inline]
    pub fn is_occluded(&self, origin: [f32; 3], direction: [f32; 3], t_far: f32) -> bool {
        let mut ray = RtcRay { origin, t_near: 0.0, direction, time: 0.0, t_far, mask: u32::MAX, id: 0, flags: 0 };
        // SAFETY: the scene is committed; null arguments mean the defaults.
        unsafe { (self.embree.api.occluded1)(self.scene, &raw mut ray, std::ptr::null_mut()) };
        ray.t_far < 0.0
    }
}
