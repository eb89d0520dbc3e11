from glob import glob

from setuptools import find_packages, setup

package_name = 'ps_reconstruction'

setup(
    name=package_name,
    version='0.1.0',
    packages=find_packages(exclude=['test']),
    package_data={package_name: ['py.typed', 'data/*', 'templates/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + package_name]),
        ('share/' + package_name, ['package.xml']),
        ('share/' + package_name + '/config', glob('config/*.yaml')),
        ('share/' + package_name + '/launch', glob('launch/*.launch.py')),
    ],
    install_requires=['setuptools'],
    zip_safe=True,
    maintainer='ps_head maintainers',
    maintainer_email='maintainers@ps-head.invalid',
    description='Photometric stereo: normals, slopes, albedo, height, surface measures.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'reconstruction = ps_reconstruction.nodes.reconstruction:main',
            'ps_diligent = ps_reconstruction.cli.ps_diligent:main',
            'ps_reconstruct = ps_reconstruction.cli.ps_reconstruct:main',
        ],
    },
)
