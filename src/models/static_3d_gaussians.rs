//! Model folders of 3D Gaussian Splatting: Gaussians without a deformation field.
//!
//! Input: `<root>/point_cloud/iteration_K/point_cloud.ply` of the requested iteration K, or of the largest. Output: a
//! folder of the same layout with fewer Gaussians, and copies of `cfg_args` and `cameras.json`.

use std::fs;
use std::path::{Path, PathBuf};

use super::cfg_args;
use super::files::copy;
use super::iterations::find_iteration;
use super::size::{ModelSize, file_bytes};
use crate::archive::ArchiveContent;
use crate::compressed_model::CompressedModel;
use crate::error::{Error, Result};
use crate::files::ply_sequence::PlySequence;
use crate::limits::Limits;
use crate::models::input_model::{InputModel, MemoryProfile, ModelDescription, OpenOptions};
use crate::models::opened::{InputFormat, Opened};
use crate::outputs::kind::OutputKind;
use crate::progress::Events;
use crate::source::FrameSource;

/// Name of the folder that holds the folders `iteration_K`.
const POINT_CLOUD_FOLDER: &str = "point_cloud";
/// Name of the point cloud file in a folder `iteration_K`.
const POINT_CLOUD_FILE: &str = "point_cloud.ply";

/// Model format of 3D Gaussian Splatting: recognizes and opens a model folder with a point cloud file and no
/// deformation field.
pub(super) const ENTRY: InputFormat = InputFormat {
    recognizes: |found| {
        let is_static =
            |folder: &Path| folder.join(POINT_CLOUD_FILE).is_file() && !folder.join("deformation.pth").exists();
        let is_static_model =
            find_iteration(&found.path.join(POINT_CLOUD_FOLDER), None).is_ok_and(|(_, folder)| is_static(&folder));
        found.is_folder && is_static_model && !has_deformation(found.path)
    },
    open: |path, options| Ok(Opened::from_model(StaticModel::open(path, options)?)),
};

/// Returns whether `cfg_args` or a file of the model folder shows that its Gaussians are deformed, even if the
/// deformation file is missing.
fn has_deformation(root: &Path) -> bool {
    let arguments = cfg_args::read(&root.join("cfg_args")).unwrap_or_default();
    root.join("deform").exists() || ["kplanes_config", "defor_depth"].iter().any(|name| arguments.contains(name))
}

/// Files of the model folder that are copied to the output if they exist.
const COPIED_FILES: [&str; 2] = ["cfg_args", "cameras.json"];

/// Opened model folder of 3DGS.
struct StaticModel {
    root: PathBuf,
    iteration: u32,
    cloud: PlySequence,
}

impl StaticModel {
    /// Opens the model folder `root` at the training iteration of `options`, or at the largest if `options` gives none.
    /// Fails if the point cloud file is missing or damaged.
    fn open(root: &Path, options: &OpenOptions) -> Result<StaticModel> {
        let (iteration, folder) = find_iteration(&root.join(POINT_CLOUD_FOLDER), options.iteration)?;
        Ok(StaticModel {
            root: root.to_owned(),
            iteration,
            cloud: PlySequence::open_single(&folder.join(POINT_CLOUD_FILE), &options.ply())?,
        })
    }

    /// Returns the paths of the files in [`COPIED_FILES`] that exist in the model folder.
    fn copied_files(&self) -> impl Iterator<Item = PathBuf> {
        COPIED_FILES.iter().map(|name| self.root.join(name)).filter(|path| path.is_file())
    }

    /// Returns the path of the point cloud file in the model folder `root`.
    fn cloud_path(&self, root: &Path) -> PathBuf {
        root.join(POINT_CLOUD_FOLDER).join(format!("iteration_{}", self.iteration)).join(POINT_CLOUD_FILE)
    }
}

impl InputModel for StaticModel {
    fn description(&self) -> ModelDescription {
        let has_configuration = self.root.join("cfg_args").exists();
        ModelDescription {
            kind: "3D Gaussian Splatting model",
            notes: self.cloud.notes().to_vec(),
            default_output_kind: OutputKind::Model,
            reason_to_keep_sh_degree: has_configuration.then_some("cfg_args fixes the SH degree"),
            ..ModelDescription::default()
        }
    }

    fn source(&self) -> &dyn FrameSource {
        &self.cloud
    }

    fn digest(&self) -> Result<String> {
        self.cloud.digest()
    }

    fn size(&self) -> Result<ModelSize> {
        Ok(ModelSize { cloud: self.cloud.bytes()?, rest: file_bytes(self.copied_files())?, ..ModelSize::default() })
    }

    fn size_written(&self, kind: OutputKind, path: &Path) -> Result<ModelSize> {
        match kind {
            OutputKind::Model => ModelSize::from_folder(path, &self.cloud_path(path)),
            _ => self.cloud.size_written(kind, path),
        }
    }

    fn memory_profile(&self) -> MemoryProfile {
        self.cloud.memory_profile()
    }

    fn with_times(self: Box<Self>, times: Vec<f64>) -> Result<Box<dyn InputModel>> {
        Ok(Box::new(StaticModel { cloud: self.cloud.with_times(times)?, ..*self }))
    }

    fn archive_content(&self, compressed: &CompressedModel) -> Result<ArchiveContent> {
        self.cloud.archive_content(compressed)
    }

    fn decode_frames<'a>(&'a self, content: &ArchiveContent) -> Result<Box<dyn FrameSource + 'a>> {
        self.cloud.decode_frames(content)
    }

    fn compressed_frames<'a>(&'a self, compressed: &'a CompressedModel) -> Result<Box<dyn FrameSource + 'a>> {
        self.cloud.compressed_frames(compressed)
    }

    fn write(
        &self,
        compressed: &CompressedModel,
        kind: OutputKind,
        path: &Path,
        limits: &Limits,
        events: &Events,
    ) -> Result<Vec<String>> {
        if kind != OutputKind::Model {
            return self.cloud.write(compressed, kind, path, limits, events);
        }
        let to = self.cloud_path(path);
        let folder = to.parent().unwrap_or(path);
        fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
        for file in self.copied_files() {
            copy(&file, &path.join(file.file_name().unwrap_or_default()))?;
        }
        self.cloud.write(compressed, OutputKind::Ply, &to, limits, events)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::ply::write::write_inria;
    use crate::model::{Attributes, Gaussians};
    use crate::models;
    use crate::models::size::bytes_below;
    use crate::passes::gather_all;
    use crate::recipe::Recipe;

    #[test]
    fn folder_without_a_field_is_read_and_written_as_static() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("model");
        for k in [7000, 30_000] {
            let cloud = root.join(format!("point_cloud/iteration_{k}"));
            fs::create_dir_all(&cloud).unwrap();
            let mut made = Gaussians::zeros(4, 3);
            made.position.planes_mut().iter_mut().enumerate().for_each(|(i, x)| *x = i as f32 + k as f32);
            write_inria(&made, &[], &cloud.join("point_cloud.ply")).unwrap();
        }
        fs::write(root.join("cfg_args"), "Namespace(sh_degree=3)").unwrap();
        let open = |path: &Path, iteration| {
            models::open(path, &OpenOptions { iteration, ..OpenOptions::default() })
                .and_then(models::Opened::into_linked)
        };
        let model = open(&root, None).unwrap();
        assert_eq!(
            (model.description().kind, model.description().default_output_kind),
            ("3D Gaussian Splatting model", OutputKind::Model)
        );
        let result = folder.path().join("result");
        fs::create_dir(&result).unwrap();
        let compressed = CompressedModel::pruned(vec![1, 3], &Recipe::preset("default").unwrap().merge);
        model.write(&compressed, OutputKind::Model, &result, &Limits::NONE, &Events::IGNORED).unwrap();
        let [all, left] =
            [&root, &result].map(|path| gather_all(open(path, None).unwrap().source(), 0, Attributes::all()).unwrap());
        assert_eq!(left, all.pick(&[1, 3]));
        assert_eq!(fs::read(result.join("cfg_args")).unwrap(), fs::read(root.join("cfg_args")).unwrap());
        assert!(result.join("point_cloud/iteration_30000/point_cloud.ply").is_file());
        assert_eq!(model.size_written(OutputKind::Model, &result).unwrap().total(), bytes_below(&result).unwrap());
        let first = gather_all(open(&root, Some(7000)).unwrap().source(), 0, Attributes::POSITION).unwrap();
        assert_eq!(first.position.row::<1>(0), [7000.0]);
        assert!(open(&root, Some(8)).err().unwrap().to_string().contains("iteration_7000, iteration_30000"));
        // A model whose deformation file is missing is not a static model.
        fs::write(root.join("cfg_args"), "Namespace(sh_degree=3, defor_depth=1)").unwrap();
        assert!(open(&root, None).err().unwrap().to_string().contains("deformation.pth"));
        for key in ["deform_type='node'", "is_6dof=False"] {
            fs::write(root.join("cfg_args"), format!("Namespace(sh_degree=3, {key})")).unwrap();
            let message = open(&root, None).err().unwrap().to_string();
            assert!(message.contains("deform, ") || message.contains("deform:"), "{message}");
            assert!(message.contains("deform.pth") && message.contains("no such folder"), "{message}");
        }
        fs::write(root.join("cfg_args"), "Namespace(sh_degree=3, deform_type='static')").unwrap();
        assert_eq!(open(&root, None).unwrap().description().kind, "3D Gaussian Splatting model");
    }
}
