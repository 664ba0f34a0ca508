/* The one file that sees OpenMesh: files into plain vertex and triangle arrays.
 *
 * Faces come through an importer of our own instead of one of OpenMesh's meshes: its half-edge
 * structure cannot hold what is not manifold and drops such faces, while we want to count them.
 * OpenMesh reports success for files that end early or name vertices that do not exist and never
 * says where; sdf/check.h looks at every value first, and what its readers then deliver is compared
 * with what the file holds.
 *
 * Coordinates arrive in single precision, whatever the file holds: 6e-8 of their size.
 * Its PLY reader keeps its state in one object: read meshes from one thread at a time.
 * Its readers parse numbers in the program's locale; a program that calls setlocale must keep
 * LC_NUMERIC at "C". Its messages are switched off, and stay off, in its two log streams. */
#include "kinegrad/mesh.h"

#include "base/read_file.h"
#include "sdf/check.h"
#include "sdf/polygon.h"
#include "sdf/topology.h"

#include <OpenMesh/Core/IO/IOManager.hh>
#include <OpenMesh/Core/IO/importer/BaseImporter.hh>
#include <OpenMesh/Core/System/omstream.hh>

#include <algorithm>
#include <cctype>
#include <climits>
#include <cstdio>
#include <exception>
#include <new>
#include <sstream>
#include <string>
#include <vector>

namespace
{

/* what is wrong with a file, on its way to kg_error */
struct refusal {
  kg_status status;
  std::string text;
};

/* What a reader tells an importer and we do not want to know. OpenMesh demands all of it. */
class deaf_importer : public OpenMesh::IO::BaseImporter
{
public:
  using C3 = OpenMesh::Vec3uc;
  using C4 = OpenMesh::Vec4uc;
  using F2 = OpenMesh::Vec2f;
  using F3 = OpenMesh::Vec3f;
  using F4 = OpenMesh::Vec4f;
  using D3 = OpenMesh::Vec3d;
  using V = OpenMesh::VertexHandle;
  using H = OpenMesh::HalfedgeHandle;
  using E = OpenMesh::EdgeHandle;
  using F = OpenMesh::FaceHandle;
  using Status = OpenMesh::Attributes::StatusInfo;
  /* clang-format off */
  H add_edge(V, V) override { return H(); }
  F add_face(H) override { return F(); }
  size_t n_edges() const override { return 0; }
  void add_face_texcoords(F, V, const std::vector<F2> &) override {}
  void add_face_texcoords(F, V, const std::vector<F3> &) override {}
  void add_texture_information(int, std::string) override {}
  void request_face_texcoords2D() override {}
  void set_face_texindex(F, int) override {}
  void set_halfedge(V, H) override {}
  void set_next(H, H) override {}
  void set_face(H, F) override {}
  void set_normal(V, const F3 &) override {}
  void set_normal(V, const D3 &) override {}
  void set_normal(F, const F3 &) override {}
  void set_normal(F, const D3 &) override {}
  void set_texcoord(V, const F2 &) override {}
  void set_texcoord(V, const F3 &) override {}
  void set_texcoord(H, const F2 &) override {}
  void set_texcoord(H, const F3 &) override {}
  void set_color(V, const C3 &) override {}
  void set_color(V, const C4 &) override {}
  void set_color(V, const F3 &) override {}
  void set_color(V, const F4 &) override {}
  void set_color(E, const C3 &) override {}
  void set_color(E, const C4 &) override {}
  void set_color(E, const F3 &) override {}
  void set_color(E, const F4 &) override {}
  void set_color(F, const C3 &) override {}
  void set_color(F, const C4 &) override {}
  void set_color(F, const F3 &) override {}
  void set_color(F, const F4 &) override {}
  void set_status(V, const Status &) override {}
  void set_status(H, const Status &) override {}
  void set_status(E, const Status &) override {}
  void set_status(F, const Status &) override {}
  /* clang-format on */
};

/* Collects vertices and faces. */
class soup_importer : public deaf_importer
{
public:
  explicit soup_importer(size_t limit) : limit_(limit)
  {
  }

  std::vector<kg_vec3> vertices;
  std::vector<int> corners;     /* of all faces, one after the other */
  std::vector<size_t> face_end; /* in corners                        */

  V add_vertex(const F3 &p) override
  {
    return add({double(p[0]), double(p[1]), double(p[2])});
  }
  V add_vertex(const D3 &p) override
  {
    return add({p[0], p[1], p[2]});
  }
  V add_vertex() override
  {
    return add({0.0, 0.0, 0.0});
  }
  void set_point(V v, const F3 &p) override
  {
    if (v.idx() >= 0 && size_t(v.idx()) < vertices.size()) {
      vertices[size_t(v.idx())] = {double(p[0]), double(p[1]), double(p[2])};
    }
  }
  F add_face(const VHandles &face) override
  {
    for (const V &v : face) {
      corners.push_back(v.idx());
    }
    check(corners.size());
    face_end.push_back(corners.size());
    return F(int(face_end.size()) - 1);
  }
  size_t n_vertices() const override
  {
    return vertices.size();
  }
  size_t n_faces() const override
  {
    return face_end.size();
  }

private:
  V add(const kg_vec3 &p)
  {
    vertices.push_back(p);
    check(vertices.size());
    return V(int(vertices.size()) - 1);
  }

  /* every vertex, and every corner of a face, takes at least a byte of the file: a count beyond
   * that comes from a header that lies */
  void check(size_t count) const
  {
    if (count > limit_) throw refusal{KG_ERR_FORMAT, "the file announces more than it holds"};
  }
  const size_t limit_;
};

std::string lower_extension(const std::string &path)
{
  const size_t dot = path.find_last_of("./");
  std::string out = dot == std::string::npos || path[dot] == '/' ? "" : path.substr(dot + 1);
  for (char &c : out) {
    c = char(std::tolower(static_cast<unsigned char>(c)));
  }
  return out;
}

kg_status check(mesh_file *file, const std::string &extension, kg_error *error)
{
  if (extension == "obj") return check_obj(file, error);
  if (extension == "off") return check_off(file, error);
  if (extension == "ply") return check_ply(file, error);
  return check_stl(file, error);
}

void compare(const char *what, long long expected, size_t found)
{
  if (expected < 0 || static_cast<unsigned long long>(expected) == found) return;
  throw refusal{KG_ERR_FORMAT, "of " + std::to_string(expected) + " " + what + " " +
                                 std::to_string(found) + " could be read"};
}

void read_soup(soup_importer &soup, const mesh_file &file, const std::string &extension)
{
  if (file.faces == 0) {
    throw refusal{KG_ERR_FORMAT, file.collapsed > 0 ? "no face has three different corners"
                                                    : "the file holds no faces"};
  }
  omerr().disable();
  omlog().disable();
  omout().disable();
  OpenMesh::IO::Options options;
  if (file.binary) options += OpenMesh::IO::Options::Binary;
  std::istringstream stream(file.plain_size > 0 ? std::string(file.plain, file.plain_size)
                                                : std::string(file.content, file.size));
  if (!OpenMesh::IO::IOManager().read(stream, "." + extension, soup, options)) {
    throw refusal{KG_ERR_FORMAT, "the file is not a readable " + extension + " mesh"};
  }
  compare("vertices", file.vertices, soup.vertices.size());
  compare("faces", file.faces, soup.face_end.size());
}

/* what was met while reading and cutting polygons */
struct odd_polygons {
  explicit odd_polygons(long long left_out) : collapsed(int(std::min(left_out, 1LL * INT_MAX)))
  {
  }
  long long repeated = 0; /* corners that the reader left out */
  int collapsed, bent = 0, tangled = 0;
  double most_bent = 0.0;
  kg_vec3 bent_at{}, tangled_at{};

  void add(const polygon_cut &cut, const kg_vec3 &where)
  {
    if (cut.too_long) {
      throw refusal{KG_ERR_UNSUPPORTED, "a polygon that is not convex has more than " +
                                          std::to_string(POLYGON_MOST_CONCAVE) + " corners"};
    }
    if (cut.bent > 0.01 * cut.size && bent++ == 0) bent_at = where;
    if (cut.tangled && tangled++ == 0) tangled_at = where;
    most_bent = std::max(most_bent, cut.bent);
  }

  void describe(kg_mesh_report *report) const
  {
    report->degenerate += collapsed;
    if (collapsed > 0) {
      report_say(report, "%d %s fewer than three different corners and %s left out\n", collapsed,
                 word_for(collapsed, "face has", "faces have"), word_for(collapsed, "was", "were"));
    }
    if (repeated > 0) {
      report_say(report,
                 "repeated: %lld %s a vertex that the face has already and %s left out; an outline "
                 "with a bridge to a hole is read right from off and ply only\n",
                 repeated, word_for(repeated, "corner names", "corners name"),
                 word_for(repeated, "was", "were"));
    }
    report->bent = bent;
    report->tangled = tangled;
    if (bent > 0) {
      report_say(report,
                 "bent: %d %s not flat, by up to %.3g m, the first at (%.4g, %.4g, %.4g); "
                 "the surface there depends on how it is cut into triangles\n",
                 bent, word_for(bent, "polygon is", "polygons are"), most_bent, bent_at.x,
                 bent_at.y, bent_at.z);
    }
    if (tangled > 0) {
      report_say(report,
                 "tangled: %d %s, the first at (%.4g, %.4g, %.4g); the triangles there overlap\n",
                 tangled, word_for(tangled, "polygon crosses itself", "polygons cross themselves"),
                 tangled_at.x, tangled_at.y, tangled_at.z);
    }
  }
};

std::vector<int> cut_polygons(const soup_importer &soup, odd_polygons &odd)
{
  std::vector<int> triangles, local, work;
  std::vector<kg_vec3> places;
  size_t begin = 0;
  for (const size_t end : soup.face_end) {
    const size_t n = end - begin;
    if (n < 3) throw refusal{KG_ERR_FORMAT, "a face has fewer than three corners"};
    places.clear();
    for (size_t k = begin; k < end; k++) {
      const int v = soup.corners[k];
      if (v < 0 || size_t(v) >= soup.vertices.size()) {
        throw refusal{KG_ERR_FORMAT, "a face uses a vertex that there is not"};
      }
      places.push_back(soup.vertices[size_t(v)]);
    }
    local.resize(3 * (n - 2));
    work.resize(n);
    odd.add(polygon_triangles(local.data(), work.data(), places.data(), int(n)), places[0]);
    for (const int k : local) {
      triangles.push_back(soup.corners[begin + size_t(k)]);
    }
    begin = end;
  }
  return triangles;
}

kg_status build(kg_mesh **mesh, soup_importer &soup, const mesh_file &file, double unit_m,
                kg_mesh_report *report, const kg_allocator *allocator, kg_error *error)
{
  for (kg_vec3 &p : soup.vertices) {
    p = kg_vec3_scale(unit_m, p);
  }
  odd_polygons odd(file.collapsed);
  odd.repeated = file.corners - static_cast<long long>(soup.corners.size());
  const std::vector<int> triangles = cut_polygons(soup, odd);
  if (triangles.size() / 3 > size_t(INT_MAX / 4)) {
    throw refusal{KG_ERR_UNSUPPORTED, "the mesh has too many triangles"};
  }
  kg_mesh_report unused;
  const kg_status status = mesh_create(
    mesh, soup.vertices.data(), int(soup.vertices.size()), triangles.data(),
    int(triangles.size() / 3), report != nullptr, report ? report : &unused, allocator, error);
  if (status == KG_OK && report) odd.describe(report);
  if (status != KG_OK && error) { /* the builder does not know the file */
    std::snprintf(error->path, sizeof error->path, "%s", file.path);
  }
  return status;
}

/* Memory that goes when a refusal passes through, too. */
struct scoped_arena {
  explicit scoped_arena(const kg_allocator *allocator)
  {
    kg_arena_init(&arena, allocator);
  }
  ~scoped_arena()
  {
    kg_arena_release(&arena);
  }
  scoped_arena(const scoped_arena &) = delete;
  scoped_arena &operator=(const scoped_arena &) = delete;
  kg_arena arena;
};

kg_status read(kg_mesh **mesh, const char *path, double unit_m, kg_mesh_report *report,
               const kg_allocator *allocator, kg_error *error)
{
  const std::string extension = lower_extension(path);
  if (extension != "obj" && extension != "ply" && extension != "off" && extension != "stl") {
    throw refusal{KG_ERR_FORMAT,
                  "the extension \"" + extension + "\" is none of obj, ply, off and stl"};
  }
  scoped_arena memory(allocator);
  char *content;
  mesh_file file = {};
  file.path = path;
  kg_status status = kg_read_file(&content, &file.size, &memory.arena, path, error);
  if (status != KG_OK) return status;
  if (file.size == 0) throw refusal{KG_ERR_READ, "the mesh file is empty"};
  std::string plain(CHECK_ROOM(file.size), ' ');
  file.content = content;
  file.plain = &plain[0];
  status = check(&file, extension, error);
  if (status != KG_OK) return status;
  soup_importer soup(std::min(file.size, size_t(INT_MAX / 4)));
  read_soup(soup, file, extension);
  return build(mesh, soup, file, unit_m, report, allocator, error);
}

} // namespace

extern "C" kg_status kg_mesh_read(kg_mesh **mesh, const char *path, double unit_m,
                                  kg_mesh_report *report, const kg_allocator *allocator,
                                  kg_error *error)
{
  KG_ASSERT(mesh && path && unit_m > 0.0);
  *mesh = nullptr;
  try {
    return read(mesh, path, unit_m, report, allocator, error);
  } catch (const refusal &why) {
    return kg_fail(error, why.status, path, 0, 0, "%s", why.text.c_str());
  } catch (const std::bad_alloc &) {
    return kg_fail(error, KG_ERR_NO_MEMORY, path, 0, 0, "no memory for the mesh");
  } catch (const std::exception &why) {
    return kg_fail(error, KG_ERR_FORMAT, path, 0, 0, "the mesh cannot be read: %s", why.what());
  } catch (...) {
    return kg_fail(error, KG_ERR_FORMAT, path, 0, 0, "the mesh cannot be read");
  }
}
