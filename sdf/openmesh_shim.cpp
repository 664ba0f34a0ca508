/* The one file that sees OpenMesh: files into plain vertex and triangle arrays.
 *
 * Faces come through an importer of our own instead of one of OpenMesh's meshes: its half-edge
 * structure cannot hold what is not manifold and drops such faces, while we want to count them.
 * OpenMesh reports success for files that end early or name vertices that do not exist, so the
 * number of faces is compared with what the file announces or, in OBJ, holds.
 *
 * Coordinates arrive in single precision, whatever the file holds: 6e-8 of their size.
 * Its PLY reader keeps its state in one object: read meshes from one thread at a time.
 * Its readers parse numbers in the program's locale; a program that calls setlocale must keep
 * LC_NUMERIC at "C". Its messages are switched off, and stay off, in its two log streams. */
#include "kinegrad/mesh.h"

#include <OpenMesh/Core/IO/IOManager.hh>
#include <OpenMesh/Core/IO/importer/BaseImporter.hh>
#include <OpenMesh/Core/System/omstream.hh>

#include <algorithm>
#include <cctype>
#include <climits>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <fstream>
#include <iterator>
#include <new>
#include <sstream>
#include <string>
#include <vector>

namespace
{

using OpenMesh::FaceHandle;
using OpenMesh::HalfedgeHandle;
using OpenMesh::VertexHandle;

/* what is wrong with a file, on its way to kg_error */
struct refusal {
  kg_status status;
  std::string text;
};

/* Collects vertices and faces; everything else a file may hold is ignored. */
class soup_importer : public OpenMesh::IO::BaseImporter
{
public:
  explicit soup_importer(size_t limit) : limit_(limit)
  {
  }

  std::vector<kg_vec3> vertices;
  std::vector<int> triangles;
  size_t faces = 0;

  VertexHandle add_vertex(const OpenMesh::Vec3f &p) override
  {
    return add({double(p[0]), double(p[1]), double(p[2])});
  }
  VertexHandle add_vertex(const OpenMesh::Vec3d &p) override
  {
    return add({p[0], p[1], p[2]});
  }
  VertexHandle add_vertex() override
  {
    return add({0.0, 0.0, 0.0});
  }
  void set_point(VertexHandle v, const OpenMesh::Vec3f &p) override
  {
    if (v.idx() >= 0 && size_t(v.idx()) < vertices.size()) {
      vertices[size_t(v.idx())] = {double(p[0]), double(p[1]), double(p[2])};
    }
  }

  /* a fan from the first corner: right for convex polygons, the only ones that are well defined */
  FaceHandle add_face(const VHandles &corners) override
  {
    faces++;
    check(3 * faces);
    for (size_t k = 2; k < corners.size(); k++) {
      for (const size_t at : {size_t(0), k - 1, k}) {
        triangles.push_back(corners[at].idx());
      }
      check(triangles.size() / 3);
    }
    return FaceHandle(int(faces) - 1);
  }

  size_t n_vertices() const override
  {
    return vertices.size();
  }
  size_t n_faces() const override
  {
    return faces;
  }
  size_t n_edges() const override
  {
    return 0;
  }
  bool is_triangle_mesh() const override
  {
    return false;
  }

  OpenMesh::VertexHandle add(const kg_vec3 &p)
  {
    vertices.push_back(p);
    check(vertices.size());
    return VertexHandle(int(vertices.size()) - 1);
  }

  /* nothing that a reader asks for beyond this point */
  using C3 = OpenMesh::Vec3uc;
  using C4 = OpenMesh::Vec4uc;
  using F2 = OpenMesh::Vec2f;
  using F3 = OpenMesh::Vec3f;
  using F4 = OpenMesh::Vec4f;
  using D3 = OpenMesh::Vec3d;
  using Status = OpenMesh::Attributes::StatusInfo;
  HalfedgeHandle add_edge(VertexHandle, VertexHandle) override
  {
    return HalfedgeHandle();
  }
  FaceHandle add_face(HalfedgeHandle) override
  {
    return FaceHandle();
  }
  void add_face_texcoords(FaceHandle, VertexHandle, const std::vector<F2> &) override
  {
  }
  void add_face_texcoords(FaceHandle, VertexHandle, const std::vector<F3> &) override
  {
  }
  void set_face_texindex(FaceHandle, int) override
  {
  }
  void set_halfedge(VertexHandle, HalfedgeHandle) override
  {
  }
  void set_normal(VertexHandle, const F3 &) override
  {
  }
  void set_normal(VertexHandle, const D3 &) override
  {
  }
  void set_color(VertexHandle, const C3 &) override
  {
  }
  void set_color(VertexHandle, const C4 &) override
  {
  }
  void set_color(VertexHandle, const F3 &) override
  {
  }
  void set_color(VertexHandle, const F4 &) override
  {
  }
  void set_texcoord(VertexHandle, const F2 &) override
  {
  }
  void set_status(VertexHandle, const Status &) override
  {
  }
  void set_next(HalfedgeHandle, HalfedgeHandle) override
  {
  }
  void set_face(HalfedgeHandle, FaceHandle) override
  {
  }
  void request_face_texcoords2D() override
  {
  }
  void set_texcoord(HalfedgeHandle, const F2 &) override
  {
  }
  void set_texcoord(VertexHandle, const F3 &) override
  {
  }
  void set_texcoord(HalfedgeHandle, const F3 &) override
  {
  }
  void set_status(HalfedgeHandle, const Status &) override
  {
  }
  void set_color(OpenMesh::EdgeHandle, const C3 &) override
  {
  }
  void set_color(OpenMesh::EdgeHandle, const C4 &) override
  {
  }
  void set_color(OpenMesh::EdgeHandle, const F3 &) override
  {
  }
  void set_color(OpenMesh::EdgeHandle, const F4 &) override
  {
  }
  void set_status(OpenMesh::EdgeHandle, const Status &) override
  {
  }
  void set_normal(FaceHandle, const F3 &) override
  {
  }
  void set_normal(FaceHandle, const D3 &) override
  {
  }
  void set_color(FaceHandle, const C3 &) override
  {
  }
  void set_color(FaceHandle, const C4 &) override
  {
  }
  void set_color(FaceHandle, const F3 &) override
  {
  }
  void set_color(FaceHandle, const F4 &) override
  {
  }
  void set_status(FaceHandle, const Status &) override
  {
  }
  void add_texture_information(int, std::string) override
  {
  }

private:
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

std::string whole_file(const char *path)
{
  std::ifstream file(path, std::ios::binary);
  std::ostringstream content;
  if (!file || !(content << file.rdbuf())) {
    throw refusal{KG_ERR_READ, "the mesh file cannot be read, or is empty"};
  }
  return content.str();
}

/* What the file says it has; -1 where the format does not tell. */
struct counts {
  long long vertices = -1, faces = -1;
};

counts announced_obj(const std::string &content)
{
  std::istringstream lines(content);
  counts out = {0, 0};
  for (std::string line; std::getline(lines, line);) {
    std::istringstream words(line);
    std::string word;
    words >> word;
    out.vertices += word == "v";
    out.faces += word == "f";
  }
  return out;
}

/* OFF, then the counts of vertices, faces and edges: on one line or two, comments between */
counts announced_off(const std::string &content)
{
  std::istringstream lines(content);
  std::string text, line;
  while (std::getline(lines, line) && text.size() < 256) {
    text += line.substr(0, line.find('#')) + ' ';
  }
  std::istringstream words(text);
  std::string magic;
  counts out;
  if (text.find("BINARY") != std::string::npos) return out;
  words >> magic >> out.vertices >> out.faces;
  if (!words || out.vertices < 0 || out.faces < 0 || std::max(out.vertices, out.faces) > INT_MAX) {
    throw refusal{KG_ERR_FORMAT, "the off file does not begin with its counts"};
  }
  return out;
}

bool is_ply_type(const std::string &type)
{
  const char *const types[] = {"char",  "uchar",  "short",   "ushort", "int",   "uint",
                               "float", "double", "int8",    "uint8",  "int16", "uint16",
                               "int32", "uint32", "float32", "float64"};
  return std::find(std::begin(types), std::end(types), type) != std::end(types);
}

/* OpenMesh makes room for any length it reads */
bool is_short_ply_type(const std::string &type)
{
  return type.find("char") != std::string::npos || type.find("short") != std::string::npos ||
         type == "int8" || type == "uint8" || type == "int16" || type == "uint16";
}

/* One line of a PLY header after the first. OpenMesh's reader trusts what is checked here. */
void check_ply_line(const std::vector<std::string> &word, counts &out, std::string &element)
{
  const size_t n = word.size();
  const refusal bad = {KG_ERR_FORMAT, "the ply header has a line that is not of its format"};
  if (n == 3 && word[0] == "format" && word[2] == "1.0" && element.empty() &&
      (word[1] == "ascii" || word[1] == "binary_little_endian" || word[1] == "binary_big_endian")) {
    return;
  }
  if (n == 3 && word[0] == "element") {
    char *end;
    const long long count = std::strtoll(word[2].c_str(), &end, 10);
    const bool vertex = word[1] == "vertex", face = word[1] == "face";
    /* vertices first, then faces: a second list of either would be mixed with the first */
    if (*end != '\0' || count < 0 || count > INT_MAX || (vertex && !element.empty()) ||
        (face && element != "vertex") || (!vertex && element.empty())) {
      throw bad;
    }
    if (vertex) out.vertices = count;
    if (face) out.faces = count;
    element = word[1];
    return;
  }
  if (element.empty() || word[0] != "property") throw bad;
  if (n == 3 && is_ply_type(word[1])) return;
  if (n != 5 || word[1] != "list" || !is_ply_type(word[2]) || !is_ply_type(word[3])) throw bad;
  if (!is_short_ply_type(word[2])) {
    throw refusal{KG_ERR_UNSUPPORTED, "lists whose length takes more than 16 bits are not read"};
  }
}

counts announced_ply(const std::string &content)
{
  std::istringstream lines(content);
  std::string line, element;
  counts out;
  bool format = false;
  std::getline(lines, line);
  if (line != "ply" && line != "ply\r") throw refusal{KG_ERR_FORMAT, "not a ply file"};
  while (std::getline(lines, line)) {
    std::istringstream words(line);
    std::vector<std::string> word;
    for (std::string w; words >> w;) {
      word.push_back(w);
    }
    if (word.size() == 1 && word[0] == "end_header") break;
    if (word.empty() || word[0] == "comment" || word[0] == "obj_info") continue;
    if (!format && word[0] != "format") break; /* it comes first: nothing may stand before it */
    format = true;
    check_ply_line(word, out, element);
  }
  if (!lines || out.faces < 0) throw refusal{KG_ERR_FORMAT, "the ply header is not complete"};
  return out;
}

/* Vertices are repeated in the file and merged by the reader: only faces can be compared. */
counts announced_stl(const std::string &content)
{
  const size_t header = 84, facet = 50;
  counts out;
  if (content.size() >= header) {
    uint32_t count = 0; /* little-endian */
    for (size_t k = 4; k-- > 0;) {
      count = count * 256u + static_cast<unsigned char>(content[80 + k]);
    }
    if ((content.size() - header) / facet == count) {
      out.faces = count; /* binary */
      return out;
    }
  }
  if (content.compare(0, 5, "solid") != 0) {
    throw refusal{KG_ERR_FORMAT, "neither a text STL nor a binary one of the length it announces"};
  }
  if (content.find("endsolid") == std::string::npos) {
    throw refusal{KG_ERR_FORMAT, "the text STL ends without endsolid"};
  }
  out.faces = 0;
  for (size_t at = content.find("endfacet"); at != std::string::npos;
       at = content.find("endfacet", at + 8)) {
    out.faces++;
  }
  return out;
}

counts announced(const std::string &content, const std::string &extension)
{
  if (extension == "obj") return announced_obj(content);
  if (extension == "off") return announced_off(content);
  if (extension == "ply") return announced_ply(content);
  return announced_stl(content);
}

void compare(const char *what, long long announced, size_t found)
{
  if (announced < 0 || static_cast<unsigned long long>(announced) == found) return;
  throw refusal{KG_ERR_FORMAT, "of " + std::to_string(announced) + " " + what + " " +
                                 std::to_string(found) +
                                 " could be read: a damaged line, or a file cut short"};
}

/* Text OFF for OpenMesh's reader, which takes the words of a comment for numbers, reads zeros where
 * the file ends early and believes any number of corners. One vertex or face a line, as it expects. */
std::string checked_off(const std::string &content, const counts &expected)
{
  std::istringstream lines(content);
  std::string out;
  long long left = expected.vertices + expected.faces; /* lines to come after the counts */
  int header_words = 4;                                /* OFF and three counts           */
  for (std::string line; std::getline(lines, line);) {
    line.resize(std::min(line.size(), line.find('#')));
    std::istringstream words(line);
    std::vector<std::string> word;
    for (std::string w; words >> w;) {
      word.push_back(w);
    }
    if (word.empty()) continue;
    out += line + '\n';
    if (header_words > 0) {
      header_words -= int(word.size());
      continue;
    }
    const bool face = left <= expected.faces && left > 0;
    if (face && std::strtoull(word[0].c_str(), nullptr, 10) >= word.size()) {
      throw refusal{KG_ERR_FORMAT, "a face has fewer corners than it announces: " + line};
    }
    left--;
  }
  if (left > 0) {
    throw refusal{KG_ERR_FORMAT, "the file ends " + std::to_string(left) + " lines too early"};
  }
  return out;
}

void read_soup(soup_importer &soup, const char *path, const std::string &content,
               const std::string &extension)
{
  const counts expected = announced(content, extension);
  omerr().disable();
  omlog().disable();
  omout().disable();
  OpenMesh::IO::Options options;
  bool read;
  if (extension == "off" && expected.faces >= 0) {
    std::istringstream plain(checked_off(content, expected));
    read = OpenMesh::IO::IOManager().read(plain, ".off", soup, options);
  } else {
    read = OpenMesh::IO::IOManager().read(path, soup, options);
  }
  if (!read) {
    throw refusal{KG_ERR_FORMAT, "the file is not a readable " + extension + " mesh"};
  }
  compare("vertices", expected.vertices, soup.vertices.size());
  compare("faces", expected.faces, soup.faces);
  if (soup.faces == 0) throw refusal{KG_ERR_FORMAT, "the file holds no faces"};
}

kg_status build(kg_mesh **mesh, soup_importer &soup, const char *path, double unit_m,
                kg_mesh_report *report, const kg_allocator *allocator, kg_error *error)
{
  for (kg_vec3 &p : soup.vertices) {
    p = kg_vec3_scale(unit_m, p);
  }
  const kg_status status =
    kg_mesh_create(mesh, soup.vertices.data(), int(soup.vertices.size()), soup.triangles.data(),
                   int(soup.triangles.size() / 3), report, allocator, error);
  if (status != KG_OK && error) { /* the builder does not know the file */
    std::snprintf(error->path, sizeof error->path, "%s", path);
  }
  return status;
}

} // namespace

extern "C" kg_status kg_mesh_read(kg_mesh **mesh, const char *path, double unit_m,
                                  kg_mesh_report *report, const kg_allocator *allocator,
                                  kg_error *error)
{
  KG_ASSERT(mesh && path && unit_m > 0.0);
  *mesh = nullptr;
  try {
    const std::string extension = lower_extension(path);
    if (extension != "obj" && extension != "ply" && extension != "off" && extension != "stl") {
      throw refusal{KG_ERR_FORMAT,
                    "the extension \"" + extension + "\" is none of obj, ply, off and stl"};
    }
    const std::string content = whole_file(path);
    soup_importer soup(std::min(content.size(), size_t(INT_MAX / 4)));
    read_soup(soup, path, content, extension);
    return build(mesh, soup, path, unit_m, report, allocator, error);
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
